"use strict";

const scoreText = (score) => (score === null ? "" : score.toFixed(2));
const byId = (id) => document.getElementById(id);
const canvas = byId("picture");
const pen = canvas.getContext("2d");
const STATES = { tracking: "#28c850", unsure: "#ffb400", lost: "#e63232" };
// as in the package's drawing: the colour of a target by its number
const COLOURS = ["#28c850", "#28a0ff", "#fadc3c", "#e65ae6", "#ff8c28", "#5adcdc", "#ff6e96", "#bebebe"];
// pictures that may be on their way: more would only grow old there
const AHEAD = 2;
const TAP_PIXELS = 6;

// sessionStorage: a reload is the same client and keeps control, another tab is another client
const client = sessionStorage.client || (sessionStorage.client = crypto.getRandomValues(new Uint32Array(4)).join(""));
let socket = null;
let state = null;        // what was last told
let shown = null;        // what was told of the picture that is on the canvas
let waiting = null;      // what was told of the picture that comes next
let bitmap = null;
let drag = null;         // the box that is being drawn, in pixels of the frame
let pause = 250;         // before the next attempt to connect
let alive = 0;           // when something was last heard

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/api/live?client=${client}`);
  socket.binaryType = "blob";
  socket.onopen = () => {
    pause = 250;
    alive = Date.now();
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
  banner("No connection to the server: trying again\u2026");
  chip(byId("link"), "no connection", "bad");
  // what is not known must not look as if it were, and what cannot be done not as if it could
  for (const id of ["fps", "latency", "tracker", "clients"]) byId(id).textContent = "\u2013";
  for (const id of ["role", "rec", "hint"]) byId(id).hidden = true;
  for (const button of document.querySelectorAll("aside button")) button.disabled = true;
  drag = null;
  draw();
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

function send(message) {
  if (socket && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
}

function hear(message) {
  if (message.type === "reply") {
    if (!message.ok) say(message.error, true);
    return;
  }
  state = message;
  for (const event of message.events) addEvent(event);
  if (message.jpeg) waiting = message;
  panel();
}

async function show(blob, told) {
  let picture = null;
  try {
    picture = await createImageBitmap(blob);
  } finally {
    send({ type: "frame" });
  }
  if (shown && told.frame < shown.frame && told.frame > 1) { picture.close(); return; }
  if (bitmap) bitmap.close();
  bitmap = picture;
  shown = told;
  draw();
}

function draw() {
  if (!bitmap || !shown) return;
  if (canvas.width !== shown.width || canvas.height !== shown.height) {
    canvas.width = shown.width;
    canvas.height = shown.height;
  }
  pen.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
  // sizes in pixels of the screen, whatever the frame's are
  const unit = canvas.width / Math.max(1, canvas.clientWidth);
  for (const target of shown.targets) drawTarget(target, unit);
  if (drag) {
    pen.setLineDash([6 * unit, 4 * unit]);
    pen.lineWidth = 2 * unit;
    pen.strokeStyle = "#fff";
    pen.strokeRect(drag.x0, drag.y0, drag.x1 - drag.x0, drag.y1 - drag.y0);
    pen.setLineDash([]);
  }
  if (!socket) {
    pen.fillStyle = "rgb(5 7 10 / 60%)";
    pen.fillRect(0, 0, canvas.width, canvas.height);
  }
}

function drawTarget(target, unit) {
  const [x, y, w, h] = target.box;
  const several = shown.targets.length > 1;
  const colour = several ? COLOURS[(target.id - 1) % COLOURS.length] : STATES[target.state ?? "tracking"];
  pen.lineWidth = (several && target.id === shown.selected ? 3.5 : 2) * unit;
  pen.strokeStyle = colour;
  pen.setLineDash(target.state === "lost" ? [5 * unit, 5 * unit] : []);
  pen.strokeRect(x, y, w, h);
  pen.setLineDash([]);
  const label = [several ? target.id : "", target.state ?? "", scoreText(target.score)].filter(Boolean).join(" ");
  pen.font = `600 ${13 * unit}px system-ui, sans-serif`;
  const width = pen.measureText(label).width + 10 * unit;
  const height = 20 * unit;
  const left = Math.min(Math.max(0, x - unit), canvas.width - width);
  const top = y - height >= 0 ? y - height : Math.min(y + h, canvas.height - height);
  pen.fillStyle = colour;
  pen.fillRect(left, top, width, height);
  pen.fillStyle = "#000";
  pen.fillText(label, left + 5 * unit, top + 14.5 * unit);
}

function panel() {
  const mine = state.operator !== "other";
  chip(byId("link"), state.source.state === "playing" ? "live" : "no picture", state.source.state === "playing" ? "good" : "bad");
  const role = byId("role");
  role.hidden = state.operator === "none";
  chip(role, state.operator === "you" ? "you control" : "another controls", state.operator === "you" ? "good" : "wait");
  byId("rec").hidden = !state.recording;
  byId("source").textContent = state.width ? `${state.source.name} \u00b7 ${state.width}\u00d7${state.height}` : state.source.name;
  byId("fps").textContent = state.fps.toFixed(0);
  byId("latency").textContent = state.latency_ms_median ?? "\u2013";
  byId("tracker").textContent = state.tracker_ms === null ? "\u2013" : state.tracker_ms.toFixed(1);
  byId("clients").textContent = state.clients;
  byId("hint").hidden = state.targets.length > 0 || !mine || state.source.state !== "playing";
  byId("stop").disabled = !mine || !state.targets.length;
  byId("stop").textContent = state.targets.length > 1 ? "Stop all" : "Stop";
  const record = byId("record");
  record.hidden = state.recording === null;
  record.disabled = !mine;
  record.textContent = state.recording ? "Stop recording" : "Record";
  const operator = byId("operator");
  operator.disabled = !mine;
  operator.textContent = state.operator === "you" ? "Hand over" : "Take control";
  canvas.classList.toggle("watching", !mine);
  if (state.source.state !== "playing") banner("The stream has stopped: it is being opened again\u2026");
  else if (byId("banner").dataset.kind !== "note") banner("");
  list(mine);
}

function list(mine) {
  const old = new Map([...byId("targets").children].map((item) => [+item.dataset.id, item]));
  for (const target of state.targets) {
    const item = old.get(target.id) || makeItem(target.id);
    old.delete(target.id);
    item.classList.toggle("selected", state.targets.length > 1 && target.id === state.selected);
    const several = state.targets.length > 1;
    item.querySelector(".swatch").style.background = several ? COLOURS[(target.id - 1) % COLOURS.length] : STATES[target.state ?? "tracking"];
    const word = item.querySelector(".state");
    word.textContent = target.state ?? "";
    word.className = `state ${target.state ?? "tracking"}`;
    item.querySelector(".score").textContent = scoreText(target.score);
    const bearing = target.bearing;
    item.querySelector("small").textContent = bearing
      ? `${angle(bearing.azimuth_deg, "right", "left")}, ${angle(bearing.elevation_deg, "up", "down")}` : "";
    for (const button of item.querySelectorAll("button")) button.disabled = !mine;
  }
  for (const item of old.values()) item.remove();
  byId("empty").hidden = state.targets.length > 0;
}

function angle(degrees, positive, negative) {
  return `${Math.abs(degrees).toFixed(1)}\u00b0 ${degrees < 0 ? negative : positive}`;
}

function makeItem(id) {
  const item = document.createElement("li");
  item.dataset.id = id;
  item.innerHTML = '<button class="pick" title="MAVLink speaks of this target"><span class="swatch"></span>'
    + '<span class="words"><span class="state"></span><small></small></span><span class="score"></span></button>'
    + '<button class="x" aria-label="stop">\u2715</button>';
  item.querySelector(".swatch").textContent = id;
  item.querySelector(".pick").onclick = () => send({ type: "select", id });
  item.querySelector(".x").onclick = () => send({ type: "stop", id });
  byId("targets").append(item);
  return item;
}

function addEvent(event) {
  const item = document.createElement("li");
  const time = document.createElement("time");
  time.textContent = new Date(1000 * event.time).toLocaleTimeString([], { hour12: false });
  item.append(time, event.text);
  byId("events").prepend(item);
  while (byId("events").children.length > 50) byId("events").lastChild.remove();
}

let noteTimer = 0;
function say(text) {
  banner(text);
  byId("banner").dataset.kind = "note";
  clearTimeout(noteTimer);
  noteTimer = setTimeout(() => banner(""), 4000);
}

function banner(text) {
  const place = byId("banner");
  place.dataset.kind = "";
  place.textContent = text;
  place.hidden = !text;
}

function chip(place, text, kind) {
  place.textContent = text;
  place.dataset.kind = kind;
}

function toFrame(event) {
  const area = canvas.getBoundingClientRect();
  const clamp = (value, most) => Math.min(Math.max(value, 0), most - 1);
  return [
    clamp((event.clientX - area.left) * canvas.width / area.width, canvas.width),
    clamp((event.clientY - area.top) * canvas.height / area.height, canvas.height),
  ];
}

canvas.addEventListener("pointerdown", (event) => {
  if (!socket || !bitmap || !event.isPrimary || event.button !== 0 || (state && state.operator === "other")) return;
  canvas.setPointerCapture(event.pointerId);
  const [x, y] = toFrame(event);
  drag = { x0: x, y0: y, x1: x, y1: y, far: 0, left: event.clientX, top: event.clientY };
});
canvas.addEventListener("pointermove", (event) => {
  if (!drag || !event.isPrimary) return;
  [drag.x1, drag.y1] = toFrame(event);
  drag.far = Math.max(drag.far, Math.abs(event.clientX - drag.left), Math.abs(event.clientY - drag.top));
  draw();
});
canvas.addEventListener("pointerup", (event) => {
  if (!drag || !event.isPrimary) return;
  const { x0, y0, x1, y1, far } = drag;
  drag = null;
  if (far < TAP_PIXELS) send({ type: "start", point: [x0, y0] });
  else send({ type: "start", box: [Math.min(x0, x1), Math.min(y0, y1), Math.abs(x1 - x0), Math.abs(y1 - y0)] });
});
canvas.addEventListener("pointercancel", () => { drag = null; draw(); });
addEventListener("keydown", (event) => {
  if (event.key === "Escape" && drag) { drag = null; draw(); }
});

byId("stop").onclick = () => send({ type: "stop" });
byId("record").onclick = () => send({ type: "record", on: !state.recording });
byId("operator").onclick = () => send({ type: "operator", take: state.operator !== "you" });

// a link that died without a word: the server says something every second
setInterval(() => { if (socket && socket.readyState === WebSocket.OPEN && Date.now() - alive > 5000) socket.close(); }, 1000);
addEventListener("resize", draw);
connect();
