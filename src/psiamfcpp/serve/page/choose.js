// Choose targets in a video, and the frame to begin at, before it is followed.
import { COLOURS, byId, drawBox, makeView, typing, wireTheme, wireTools } from "/view.js";

const MOST_TARGETS = 8;
let session = sessionStorage.psiamfcppChoose || "";
let source = null;      // what the server says of the source
let frame = 0;          // the number of the frame on the canvas
let wanted = null;      // the frame that was asked for, while it is being read
let boxes = [];         // of the targets, on this frame
let chosen = -1;        // which of them the next box replaces
let adding = false;
let still = false;      // a live image stands still while one draws
let ended = false;

const view = makeView(byId("picture"), {
  mayDraw: () => source !== null && wanted === null && !ended,
  hold,
  free: () => { if (!boxes.length) resume(); },
  box: (box, more) => take(box, more),
  tap: propose,
  paint: (pen, unit) => boxes.forEach((box, at) => drawBox(
    pen, view, box, boxes.length > 1 ? String(at + 1) : "", COLOURS[at % COLOURS.length], unit, { thick: at === chosen },
  )),
  tell: (text) => { byId("live").textContent = text; byId("hint").textContent = text; },
});

// ---- talking to the server
async function ask(path, body) {
  const headers = { Authorization: `Bearer ${session}` };
  if (body) headers["Content-Type"] = "application/json";
  const answer = await fetch(path, { method: body ? "POST" : "GET", headers, body: body && JSON.stringify(body) });
  if (!answer.ok) throw new Error((await answer.json()).error);
  return answer;
}

async function enter() {
  const token = new URLSearchParams(location.search).get("token");
  // the address is of use once: it must not be found in the history
  history.replaceState(null, "", "/");
  if (!token && !session) throw new Error("Open the address that the command printed.");
  if (token) session = (await (await ask("/api/enter", { token })).json()).session;
  sessionStorage.psiamfcppChoose = session;
  source = await (await ask("/api/source")).json();
  byId("source").textContent = `${source.name} \u00b7 ${source.width}\u00d7${source.height}`;
  chip(source.live ? "live" : "choose", "good");
  byId("time").hidden = source.live;
  if (source.live) watch();
  else goTo(source.start);
}

function fail(error) {
  // what fetch throws itself says nothing to a user
  const gone = error instanceof TypeError;
  if (gone) { ended = true; chip("ended", "bad"); }
  banner(gone ? "The command has ended: this page can be closed." : error.message, gone);
}

async function get(query) {
  const answer = await ask(`/api/frame?${query}`);
  const number = +answer.headers.get("X-Frame");
  const count = answer.headers.get("X-Count");
  return { number, count: count ? +count : null, image: await createImageBitmap(await answer.blob()) };
}

// ---- files: any frame; those far ahead are read on the way, and shown meanwhile
async function goTo(number) {
  const busy = wanted !== null;
  wanted = Math.max(0, number);
  if (boxes.length) clear("The boxes belonged to another frame: draw again.");
  if (busy) return;
  try {
    while (wanted !== null) {
      const got = await get(`number=${wanted}`);
      if (got.count !== null) source.frames = got.count;
      if (got.number === wanted || got.number === source.frames - 1) wanted = null;
      display(got);
    }
  } catch (error) { wanted = null; fail(error); }
}

function display({ number, image }) {
  frame = number;
  view.show(image, source.width, source.height);
  panel();
}

// ---- live sources: the newest frame, until one draws
async function watch() {
  try {
    while (!still && !ended) {
      const got = await get(`after=${frame}`);
      if (still) got.image.close();
      else display(got);
    }
  } catch (error) { fail(error); }
}

function hold() {
  if (!source.live || still) return;
  still = true;
  ask("/api/hold", { frame }).catch(fail);
  panel();
}

function resume() {
  if (!still) return;
  still = false;
  clear();
  watch();
}

// ---- targets
async function propose(point, more) {
  try {
    const { box } = await (await ask("/api/propose", { frame, point })).json();
    if (box) take(box, more);
    else {
      banner("Nothing to follow was found there: draw a box round it.");
      if (!boxes.length) resume();
    }
  } catch (error) { fail(error); }
}

function take(box, more) {
  const [, , w, h] = box;
  if (w < 1 || h < 1) { banner("This box holds no pixel: draw a larger one."); return; }
  if (chosen >= 0 && !adding && !more) boxes[chosen] = box;
  else if (boxes.length < MOST_TARGETS) chosen = boxes.push(box) - 1;
  else banner(`${MOST_TARGETS} targets are the most.`);
  adding = false;
  byId("live").textContent = `Target ${chosen + 1}: ${box.map(Math.round).join(", ")}`;
  banner("");
  panel();
}

function remove(at) {
  boxes.splice(at, 1);
  chosen = Math.min(chosen, boxes.length - 1);
  panel();
}

function clear(why = "") {
  boxes = [];
  chosen = -1;
  adding = false;
  if (why) banner(why);
  panel();
}

async function follow() {
  if (!boxes.length || ended) return;
  try {
    await ask("/api/choose", { frame, boxes });
    ended = true;
    banner("Following has begun in the terminal: this page can be closed.", true);
    chip("chosen", "good");
    sessionStorage.removeItem("psiamfcppChoose");
  } catch (error) { fail(error); }
  panel();
}

// ---- what is shown beside the image
function panel() {
  const slider = byId("slider");
  slider.max = source.frames === null ? Math.max(+slider.max, frame + 1000) : source.frames - 1;
  slider.value = wanted ?? frame;
  const moment = time(frame / source.fps);
  slider.setAttribute("aria-valuetext", `frame ${frame}, ${moment}`);
  byId("moment").textContent = wanted === null ? `${moment} \u00b7 frame ${frame}` : `reading: frame ${frame} of ${wanted}`;
  byId("follow").disabled = !boxes.length || ended;
  byId("follow").textContent = boxes.length > 1 ? `Follow ${boxes.length} targets` : "Follow";
  byId("resume").hidden = !still || ended;
  byId("add").hidden = !boxes.length || ended;
  byId("add").setAttribute("aria-pressed", adding);
  byId("empty").hidden = boxes.length > 0;
  byId("hint").textContent = hint();
  byId("targets").replaceChildren(...boxes.map(item));
  view.draw();
}

function hint() {
  if (wanted !== null) return "Reading to this frame\u2026";
  if (adding) return "Draw one more target, or tap on it.";
  return boxes.length ? "Enter follows. Draw again to replace the chosen box." : "Draw a box round a target, or tap on it.";
}

function item(box, at) {
  const line = document.createElement("li");
  line.classList.toggle("selected", at === chosen);
  line.innerHTML = '<button class="pick"><span class="swatch"></span><span class="words"></span></button><button class="x">\u2715</button>';
  const [pick, cross] = line.querySelectorAll("button");
  pick.querySelector(".swatch").textContent = at + 1;
  pick.querySelector(".swatch").style.background = COLOURS[at % COLOURS.length];
  pick.querySelector(".words").textContent = box.map(Math.round).join(", ");
  pick.setAttribute("aria-label", `choose target ${at + 1}: ${box.map(Math.round).join(", ")}`);
  pick.setAttribute("aria-pressed", at === chosen);
  cross.setAttribute("aria-label", `remove target ${at + 1}`);
  pick.onclick = () => { chosen = at; panel(); };
  cross.onclick = () => remove(at);
  return line;
}

function time(seconds) {
  const minutes = Math.floor(seconds / 60);
  return `${minutes}:${(seconds - 60 * minutes).toFixed(2).padStart(5, "0")}`;
}

let bannerTimer = 0;
function banner(text, stays = false) {
  clearTimeout(bannerTimer);
  byId("banner").textContent = text;
  byId("banner").hidden = !text;
  if (text && !stays) bannerTimer = setTimeout(() => banner(""), 6000);
}

function chip(text, kind) {
  byId("link").textContent = text;
  byId("link").dataset.kind = kind;
}

function step(event, sign) {
  if (!source.live) goTo((wanted ?? frame) + sign * (event.shiftKey ? Math.round(source.fps) : 1));
}

const KEYS = {
  ",": (event) => step(event, -1), "<": (event) => step(event, -1), ";": (event) => step(event, -1),
  ".": (event) => step(event, 1), ">": (event) => step(event, 1), ":": (event) => step(event, 1),
  a: toggleAdding,
  Delete: () => chosen >= 0 && remove(chosen),
  Backspace: () => chosen >= 0 && remove(chosen),
  "?": () => byId("help").showModal(),
  Enter: follow,
};

function toggleAdding() {
  adding = boxes.length > 0 && !adding;
  panel();
}

addEventListener("keydown", (event) => {
  if (!source || ended || typing(event)) return;
  if (view.key(event)) { event.preventDefault(); return; }
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (/^[1-8]$/.test(event.key) && +event.key <= boxes.length) { chosen = +event.key - 1; panel(); return; }
  if (KEYS[event.key]) { event.preventDefault(); KEYS[event.key](event); }
});
byId("slider").oninput = () => goTo(+byId("slider").value);
byId("back").onclick = (event) => step(event, -1);
byId("forth").onclick = (event) => step(event, 1);
byId("add").onclick = toggleAdding;
byId("follow").onclick = follow;
byId("resume").onclick = resume;
wireTheme();
wireTools(view);
enter().catch(fail);
