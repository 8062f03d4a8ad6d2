// The page of `serve`: the live image, its targets, and what an operator commands.
import { COLOURS, STATES, byId, drawBox, makeView, typing, wireTheme, wireTools } from "/view.js";

// pictures that may be on their way: more would only grow old there
const AHEAD = 2;
const DASH = "\u2013";

// sessionStorage: a reload is the same client and keeps control, another tab is another client
const client = sessionStorage.client || (sessionStorage.client = crypto.getRandomValues(new Uint32Array(4)).join(""));
let socket = null;
let state = null;        // what was last told
let shown = null;        // what was told of the picture that is on the canvas
let waiting = null;      // what was told of the picture that comes next
let still = false;       // the image stands still while one draws
let adding = false;      // the next box is one more target
let pause = 250;         // before the next attempt to connect
let alive = 0;           // when something was last heard
let requests = 0;
let sound = false;       // whether losing a target is heard
let lost = new Set();    // targets that were lost when last told
let audio = null;
const replies = new Map();   // what to do with the answers that are still to come

const view = makeView(byId("picture"), {
  mayDraw: () => Boolean(socket && shown && state && state.operator !== "other"),
  hold: () => { still = true; send({ type: "hold", frame: shown.frame }); panel(); },
  free: () => { release(); },
  box: (box, more) => start({ box }, more),
  tap: (point, more) => start({ point }, more),
  paint: (pen, unit) => shown.targets.forEach((target) => paint(pen, target, unit)),
  tell: (text) => { byId("live").textContent = text; byId("hint").textContent = text; },
});

// ---- the connection
function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/api/live?client=${client}`);
  socket.binaryType = "blob";
  socket.onopen = () => {
    pause = 250;
    alive = Date.now();
    view.dimmed = false;
    for (let i = 0; i < AHEAD; i++) send({ type: "frame" });
  };
  socket.onmessage = (message) => {
    alive = Date.now();
    if (typeof message.data === "string") hear(JSON.parse(message.data));
    else show(message.data, waiting);
  };
  socket.onclose = lose;
}

async function lose() {
  socket = null;
  still = false;
  replies.clear();
  banner("No connection to the server: trying again\u2026", "lost");
  chip(byId("link"), "no connection", "bad");
  // what is not known must not look as if it were, and what cannot be done not as if it could
  for (const id of ["fps", "latency", "tracker", "clients", "clock"]) byId(id).textContent = DASH;
  for (const id of ["role", "rec", "hint", "why"]) byId(id).hidden = true;
  for (const control of document.querySelectorAll("aside button, aside input")) control.disabled = true;
  view.dimmed = true;
  view.cancel();
  try {
    // a browser does not tell why a WebSocket was refused
    const answer = await fetch("/api/state");
    if (answer.status === 401) return login();
  } catch { /* the server is away */ }
  setTimeout(connect, pause);
  pause = Math.min(2 * pause, 2000);
}

function login(wrong = "") {
  banner("");
  byId("wrong").hidden = !wrong;
  byId("wrong").textContent = wrong;
  byId("login").showModal();
}

byId("login").addEventListener("cancel", (event) => event.preventDefault());
byId("login").querySelector("form").addEventListener("submit", async () => {
  const body = JSON.stringify({ token: byId("token").value });
  const answer = await fetch("/api/login", { method: "POST", headers: { "Content-Type": "application/json" }, body });
  if (answer.ok) connect();
  else login(answer.status === 429 ? "Too many attempts: wait some seconds." : "That is not the token.");
});

/** Send a message; `answered` is called with the reply, whether it was refused or not. */
function send(message, answered) {
  if (!socket || socket.readyState !== WebSocket.OPEN) return;
  if (message.type !== "frame") message.request = ++requests;
  if (answered) replies.set(requests, answered);
  socket.send(JSON.stringify(message));
}

function hear(message) {
  if (message.type === "reply") {
    const answered = replies.get(message.request);
    replies.delete(message.request);
    if (answered) answered(message);
    if (!message.ok) note(message.error);
    return;
  }
  state = message;
  for (const event of message.events) addEvent(event);
  if (message.jpeg) waiting = message;
  repaint();
  panel();
}

/** Show what is told anew of the frame on the canvas, as when a box is drawn while a file is paused. */
function repaint() {
  if (still || !shown || state.frame !== shown.frame) return;
  shown = state;
  view.draw();
}

async function show(blob, told) {
  let picture = null;
  try {
    picture = await createImageBitmap(blob);
  } finally {
    send({ type: "frame" });
  }
  const older = shown && told.frame < shown.frame && told.frame > 1;
  if (still || older) { picture.close(); return; }
  shown = told;
  view.show(picture, told.width, told.height);
}

// ---- drawing
function start(what, more) {
  const chosen = state.targets.some((target) => target.id === state.selected) ? state.selected : null;
  const replace = adding || more ? null : chosen;
  send({ type: "start", ...what, frame: shown.frame, replace }, (reply) => {
    if (reply.ok) adding = false;
    release();
  });
}

/** Let the image move again. */
function release() {
  still = false;
  if (socket) send({ type: "hold" });
  if (!state) return;
  repaint();
  panel();
}

function paint(pen, target, unit) {
  const several = shown.targets.length > 1;
  const label = [several ? target.id : "", target.state ?? "", score(target)].filter(Boolean).join(" ");
  const thick = several && target.id === shown.selected;
  drawBox(pen, view, target.box, label, colour(target, several), unit, { thick, dashed: target.state === "lost" });
}

const colour = (target, several) => (several ? COLOURS[(target.id - 1) % COLOURS.length] : STATES[target.state ?? "tracking"]);
const score = (target) => (target.score === null ? "" : target.score.toFixed(2));

// ---- what is shown beside the image
function panel() {
  if (!socket) return;
  const mine = state.operator !== "other";
  heading();
  figures();
  playing(mine);
  commands(mine);
  list(mine);
  byId("hint").hidden = !mine || !shown || !(still || adding || !state.targets.length);
  if (!view.keys) byId("hint").textContent = hint();
  byId("picture").classList.toggle("watching", !mine);
  listen();
  if (state.asked) banner("Another viewer asks for control: hand over (C), or go on.", "asked");
  else if (state.source.state === "silent") banner("The stream has stopped: it is being opened again\u2026", "silent");
  else if (byId("banner").dataset.kind !== "note") banner("");
}

function heading() {
  const kinds = { playing: ["live", "good"], paused: ["paused", "wait"], silent: ["no image", "bad"] };
  const [text, kind] = kinds[state.source.state];
  chip(byId("link"), state.source.live || text !== "live" ? text : "playing", kind);
  byId("role").hidden = state.operator === "none";
  const roles = { you: ["you control", "good"], other: ["another controls", "wait"], none: ["", ""] };
  chip(byId("role"), ...(state.asked ? ["you are asked to hand over", "wait"] : roles[state.operator]));
  byId("rec").hidden = !state.recording;
  byId("source").textContent = state.width ? `${state.source.name} \u00b7 ${state.width}\u00d7${state.height}` : state.source.name;
}

/** All of the same last frames; a dash where there is nothing to tell. */
function figures() {
  const runs = state.source.state === "playing";
  byId("fps").textContent = runs && state.fps ? state.fps.toFixed(0) : DASH;
  byId("latency").textContent = runs ? state.latency_ms_median?.toFixed(1) ?? DASH : DASH;
  byId("tracker").textContent = runs ? state.tracker_ms_median?.toFixed(1) ?? DASH : DASH;
  byId("clients").textContent = state.clients;
}

function playing(mine) {
  const { live, frame, frames, fps } = state.source;
  byId("time").hidden = live;
  if (live) return;
  const slider = byId("slider");
  slider.disabled = !mine || frames === null;
  slider.max = (frames ?? 1) - 1;
  if (!sliding) slider.value = frame;
  slider.setAttribute("aria-valuetext", time(frame / fps));
  byId("pause").disabled = !mine;
  byId("pause").textContent = state.source.state === "paused" ? "Play" : "Pause";
  byId("clock").textContent = frames === null ? time(frame / fps) : `${time(frame / fps)} / ${time(frames / fps)}`;
}

function commands(mine) {
  const stop = byId("stop");
  stop.disabled = !mine || !state.targets.length;
  stop.textContent = state.targets.length > 1 ? "Stop all" : "Stop";
  byId("record").hidden = state.recording === null;
  byId("record").disabled = !mine;
  byId("record").textContent = state.recording ? "Stop recording" : "Record";
  byId("recorded").hidden = state.recording === null;
  byId("snapshot").disabled = !shown;
  byId("operator").disabled = false;
  byId("operator").textContent = { you: "Hand over", other: "Ask for control", none: "Take control" }[state.operator];
  byId("why").hidden = mine;
  byId("why").textContent = mine ? "" : "Another operator is in control: it is yours when they hand over, or 15 s after they leave.";
  byId("sound").disabled = false;
  byId("add").hidden = !state.targets.length;
  byId("add").disabled = !mine;
  byId("add").setAttribute("aria-pressed", adding);
}

function hint() {
  if (state.targets.length && adding) return "Draw one more target, or tap on it.";
  if (!still) return "Draw a box round a target, or tap on it.";
  return "The image stands still while you draw.";
}

function list(mine) {
  const old = new Map([...byId("targets").children].map((item) => [+item.dataset.id, item]));
  const several = state.targets.length > 1;
  for (const target of state.targets) {
    const item = old.get(target.id) || makeItem(target.id);
    old.delete(target.id);
    const selected = target.id === state.selected;
    item.classList.toggle("selected", several && selected);
    item.querySelector(".pick").setAttribute("aria-pressed", selected);
    item.querySelector(".swatch").style.background = colour(target, several);
    const word = item.querySelector(".state");
    word.textContent = target.state ?? "";
    word.className = `state ${target.state ?? "tracking"}`;
    item.querySelector(".score").textContent = score(target);
    const bearing = target.bearing;
    item.querySelector("small").textContent = bearing
      ? `${angle(bearing.azimuth_deg, "right", "left")}, ${angle(bearing.elevation_deg, "up", "down")}` : "";
    for (const button of item.querySelectorAll("button")) button.disabled = !mine;
  }
  for (const item of old.values()) item.remove();
  byId("empty").hidden = state.targets.length > 0;
}

/** A sound where a target is lost that was not, if it is wanted. */
function listen() {
  const now = new Set(state.targets.filter((target) => target.state === "lost").map((target) => target.id));
  if (sound && [...now].some((id) => !lost.has(id))) beep();
  lost = now;
}

function beep() {
  audio ??= new AudioContext();
  const tone = audio.createOscillator();
  const loudness = audio.createGain();
  loudness.gain.value = 0.2;
  tone.frequency.setValueAtTime(880, audio.currentTime);
  tone.frequency.setValueAtTime(587, audio.currentTime + 0.15);
  tone.connect(loudness).connect(audio.destination);
  tone.start();
  tone.stop(audio.currentTime + 0.3);
}

/** Sound is off until it is asked for: browsers play none before a click or a key. */
function toggleSound() {
  sound = !sound;
  byId("sound").setAttribute("aria-pressed", sound);
  if (sound) beep();
}

function angle(degrees, positive, negative) {
  return `${Math.abs(degrees).toFixed(1)}\u00b0 ${degrees < 0 ? negative : positive}`;
}

function makeItem(id) {
  const item = document.createElement("li");
  item.dataset.id = id;
  item.innerHTML = '<button class="pick"><span class="swatch"></span><span class="words"><span class="state"></span>'
    + '<small></small></span><span class="score" title="probability that the target is in the box"></span></button>'
    + '<button class="x">\u2715</button>';
  item.querySelector(".swatch").textContent = id;
  item.querySelector(".pick").title = `choose target ${id}: the next box replaces it, and ground stations hear of it`;
  item.querySelector(".x").setAttribute("aria-label", `stop target ${id}`);
  item.querySelector(".pick").onclick = () => send({ type: "select", id });
  item.querySelector(".x").onclick = () => send({ type: "stop", id });
  byId("targets").append(item);
  return item;
}

function addEvent(event) {
  const item = document.createElement("li");
  const when = document.createElement("time");
  when.textContent = new Date(1000 * event.time).toLocaleTimeString([], { hour12: false });
  item.append(when, event.text);
  byId("events").prepend(item);
  while (byId("events").children.length > 50) byId("events").lastChild.remove();
}

function time(seconds) {
  const whole = Math.floor(seconds);
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

let noteTimer = 0;
function note(text) {
  banner(text, "note");
  clearTimeout(noteTimer);
  noteTimer = setTimeout(() => { if (byId("banner").dataset.kind === "note") banner(""); }, 5000);
}

function banner(text, kind = "") {
  const place = byId("banner");
  place.dataset.kind = kind;
  // a live region speaks whenever its text is set, even to the same
  if (place.textContent !== text) place.textContent = text;
  place.hidden = !text;
}

function chip(place, text, kind) {
  place.textContent = text;
  place.dataset.kind = kind;
}

// ---- recordings
async function listRecordings() {
  if (!byId("recorded").open) return;
  const answer = await fetch("/api/recordings");
  const found = answer.ok ? await answer.json() : [];
  byId("recordings").replaceChildren(...(found.length ? found.map(recording) : [document.createTextNode("None yet.")]));
}

function recording({ name, files }) {
  const line = document.createElement("li");
  line.append(`${name} `);
  for (const file of files) {
    const link = document.createElement("a");
    link.href = `/api/recordings/${encodeURIComponent(name)}/${encodeURIComponent(file.name)}`;
    link.download = `${name}-${file.name}`;
    link.textContent = `${file.name} (${size(file.bytes)})`;
    line.append(link);
  }
  return line;
}

const size = (bytes) => (bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`);

// ---- commands
let sliding = false;
const paused = () => state.source.state === "paused";
const togglePause = () => !state.source.live && send({ type: "pause", on: !paused() });
const record = () => state.recording !== null
  && send({ type: "record", on: !state.recording }, () => setTimeout(listRecordings, 300));
const control = () => send({ type: "operator", take: state.operator !== "you" });
const toggleAdding = () => { adding = state.targets.length > 0 && !adding; panel(); };
const stopChosen = () => state.selected !== null && send({ type: "stop", id: state.selected });

function step(sign) {
  const { live, frame, frames, fps } = state.source;
  if (live) return;
  const wanted = frame + sign * (paused() ? 1 : Math.round(5 * fps));
  send({ type: "seek", frame: Math.min(Math.max(0, wanted), (frames ?? Infinity) - 1) });
}

function snapshot() {
  const link = document.createElement("a");
  link.href = "/api/snapshot.jpg";
  link.download = "";
  link.click();
}

const KEYS = {
  a: toggleAdding, r: record, s: snapshot, c: control, p: togglePause, m: toggleSound,
  x: () => send({ type: "stop" }), Delete: stopChosen, Backspace: stopChosen,
  ",": () => step(-1), ".": () => step(1), "?": () => byId("help").showModal(),
};

addEventListener("keydown", (event) => {
  if (!state || !socket || typing(event)) return;
  if (view.key(event)) { event.preventDefault(); return; }
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const target = /^[1-8]$/.test(event.key) && state.targets[+event.key - 1];
  if (target) send({ type: "select", id: target.id });
  else if (KEYS[event.key]) { event.preventDefault(); KEYS[event.key](); }
});

byId("stop").onclick = () => send({ type: "stop" });
byId("record").onclick = record;
byId("snapshot").onclick = snapshot;
byId("operator").onclick = control;
byId("pause").onclick = togglePause;
byId("add").onclick = toggleAdding;
byId("sound").onclick = toggleSound;
byId("recorded").ontoggle = listRecordings;
byId("slider").oninput = () => { sliding = true; };
byId("slider").onchange = () => {
  sliding = false;
  send({ type: "seek", frame: +byId("slider").value });
};

// a link that died without a word: the server says something every second
setInterval(() => { if (socket && socket.readyState === WebSocket.OPEN && Date.now() - alive > 5000) socket.close(); }, 1000);
wireTheme();
wireTools(view);
connect();
