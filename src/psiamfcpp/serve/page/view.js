// The image, scaled to its place: zoom, drawing by pointer and by keys. Shared by the pages.

// as in the package's drawing: the colour of a target by its number
export const COLOURS = ["#28c850", "#28a0ff", "#fadc3c", "#e65ae6", "#ff8c28", "#5adcdc", "#ff6e96", "#bebebe"];
export const STATES = { tracking: "#28c850", unsure: "#ffb400", lost: "#ff6b61" };
const TAP_PIXELS = 6;
const MOST_ZOOM = 16;

export const byId = (id) => document.getElementById(id);

/**
 * A view on a canvas.
 *
 * hooks.mayDraw()            whether drawing is allowed now
 * hooks.hold(), hooks.free() drawing begins on the image that is shown; it was given up
 * hooks.box([x, y, w, h], more), hooks.tap([x, y], more)   what was drawn; more: Shift was down
 * hooks.paint(pen, unit)     draw over the image, in pixels of the frame; unit is a pixel of the screen
 * hooks.tell(text)           a line for who draws
 */
export function makeView(canvas, hooks) {
  const pen = canvas.getContext("2d");
  const view = {
    image: null, width: 0, height: 0, dimmed: false,
    zoom: 1, cx: 0, cy: 0,   // the frame's pixel in the middle
    drag: null,              // what the pointer draws
    keys: null,              // what the keys draw, [x, y, w, h]
  };

  view.show = (image, width, height) => {
    if (view.image) view.image.close();
    view.image = image;
    if (width !== view.width || height !== view.height) {
      Object.assign(view, { width, height, zoom: 1, cx: width / 2, cy: height / 2 });
    }
    view.draw();
  };

  // ---- geometry
  const scale = () => view.zoom * Math.min(canvas.clientWidth / view.width, canvas.clientHeight / view.height);
  const clamp = (value, least, most) => Math.min(Math.max(value, least), Math.max(least, most));
  const origin = () => {
    const s = scale();
    return [canvas.clientWidth / 2 - view.cx * s, canvas.clientHeight / 2 - view.cy * s, s];
  };

  function keepInside() {
    const s = scale();
    const inside = (middle, length, room) => (length * s <= room
      ? length / 2 : clamp(middle, room / 2 / s, length - room / 2 / s));
    view.cx = inside(view.cx, view.width, canvas.clientWidth);
    view.cy = inside(view.cy, view.height, canvas.clientHeight);
  }

  function toFrame(event) {
    const area = canvas.getBoundingClientRect();
    const [left, top, s] = origin();
    return [
      clamp((event.clientX - area.left - left) / s, 0, view.width - 1),
      clamp((event.clientY - area.top - top) / s, 0, view.height - 1),
    ];
  }

  // the frame's pixel under a place on the screen stays there
  function zoomAt(clientX, clientY, factor) {
    if (!view.image) return;
    const area = canvas.getBoundingClientRect();
    const dx = clientX - area.left - canvas.clientWidth / 2;
    const dy = clientY - area.top - canvas.clientHeight / 2;
    const before = scale();
    view.zoom = clamp(view.zoom * factor, 1, MOST_ZOOM);
    const after = scale();
    view.cx += dx / before - dx / after;
    view.cy += dy / before - dy / after;
    view.draw();
  }

  view.zoomBy = (factor) => {
    const area = canvas.getBoundingClientRect();
    zoomAt(area.left + area.width / 2, area.top + area.height / 2, factor);
  };
  view.fit = () => { view.zoom = 1; view.draw(); };

  // ---- painting
  view.draw = () => {
    const ratio = window.devicePixelRatio || 1;
    const [wide, high] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (canvas.width !== wide || canvas.height !== high) Object.assign(canvas, { width: wide, height: high });
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.clearRect(0, 0, wide, high);
    if (!view.image || !wide || !high) return;
    keepInside();
    const [left, top, s] = origin();
    Object.assign(canvas.dataset, { left, top, scale: s });
    pen.setTransform(s * ratio, 0, 0, s * ratio, left * ratio, top * ratio);
    pen.imageSmoothingEnabled = s < 4;
    pen.drawImage(view.image, 0, 0, view.width, view.height);
    hooks.paint(pen, 1 / s);
    if (view.drag) outline(boxOf(view.drag), 1 / s);
    if (view.keys) outline(view.keys, 1 / s);
    if (view.dimmed) {
      pen.fillStyle = "rgb(5 7 10 / 60%)";
      pen.fillRect(0, 0, view.width, view.height);
    }
  };

  // white on black, so that it is seen on every ground
  function outline([x, y, w, h], unit) {
    for (const [colour, width, dash] of [["#000", 4, []], ["#fff", 2, [6, 4]]]) {
      pen.setLineDash(dash.map((part) => part * unit));
      pen.lineWidth = width * unit;
      pen.strokeStyle = colour;
      pen.strokeRect(x, y, w, h);
    }
    pen.setLineDash([]);
  }

  const boxOf = ({ x0, y0, x1, y1 }) => [Math.min(x0, x1), Math.min(y0, y1), Math.abs(x1 - x0), Math.abs(y1 - y0)];

  // ---- pointers: one draws, two zoom, the middle button moves
  const pointers = new Map();

  function begin(event) {
    if (!view.image || !hooks.mayDraw()) return;
    const [x, y] = toFrame(event);
    view.keys = null;
    view.drag = { x0: x, y0: y, x1: x, y1: y, far: 0, left: event.clientX, top: event.clientY };
    hooks.hold();
  }

  view.cancel = () => {
    const drawing = view.drag || view.keys;
    view.drag = view.keys = null;
    if (drawing) hooks.free();
    view.draw();
    return Boolean(drawing);
  };

  canvas.addEventListener("pointerdown", (event) => {
    if (event.button > 1) return;
    canvas.focus({ preventScroll: true });
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, pans: event.button === 1 });
    if (event.button === 1) event.preventDefault();
    else if (pointers.size === 1) begin(event);
    else view.cancel();
  });

  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    if (pointers.size === 2) pinch(event);
    else if (last.pans) pan(event.clientX - last.x, event.clientY - last.y);
    else if (view.drag) stretch(event);
    Object.assign(last, { x: event.clientX, y: event.clientY });
  });

  function stretch(event) {
    const drag = view.drag;
    [drag.x1, drag.y1] = toFrame(event);
    drag.far = Math.max(drag.far, Math.abs(event.clientX - drag.left), Math.abs(event.clientY - drag.top));
    view.draw();
  }

  function pan(dx, dy) {
    const s = scale();
    view.cx -= dx / s;
    view.cy -= dy / s;
    view.draw();
  }

  function pinch(event) {
    const moved = pointers.get(event.pointerId);
    const [other] = [...pointers.entries()].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    const before = Math.hypot(moved.x - other.x, moved.y - other.y);
    const after = Math.hypot(event.clientX - other.x, event.clientY - other.y);
    pan((event.clientX - moved.x) / 2, (event.clientY - moved.y) / 2);
    zoomAt((event.clientX + other.x) / 2, (event.clientY + other.y) / 2, after / Math.max(1, before));
  }

  canvas.addEventListener("pointerup", (event) => {
    pointers.delete(event.pointerId);
    if (!view.drag) return;
    const drag = view.drag;
    view.drag = null;
    if (drag.far < TAP_PIXELS) hooks.tap([drag.x0, drag.y0], event.shiftKey);
    else hooks.box(boxOf(drag), event.shiftKey);
    view.draw();
  });
  canvas.addEventListener("pointercancel", (event) => { pointers.delete(event.pointerId); view.cancel(); });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomAt(event.clientX, event.clientY, Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.002)));
  }, { passive: false });

  // ---- keys: a box in the middle that is moved and sized
  view.startKeys = () => {
    if (!view.image || !hooks.mayDraw() || view.keys) return;
    const side = Math.max(8, Math.min(canvas.clientWidth, canvas.clientHeight) / scale() / 6);
    view.drag = null;
    view.keys = [view.cx - side / 2, view.cy - side / 2, side, side];
    canvas.focus({ preventScroll: true });
    hooks.hold();
    tellKeys("Arrows move the box, Shift with arrows sizes it, Enter takes it, Escape cancels. ");
    view.draw();
  };

  const tellKeys = (before = "") => hooks.tell(`${before}Box ${view.keys.map(Math.round).join(", ")}`);

  function moveKeys(dx, dy, event) {
    // a few pixels of the screen; with Ctrl one of the frame
    const step = event.ctrlKey ? 1 : Math.max(1, Math.round(4 / scale()));
    const [x, y, w, h] = view.keys;
    const at = event.shiftKey
      ? [x, y, clamp(w + dx * step, 2, view.width), clamp(h + dy * step, 2, view.height)]
      : [clamp(x + dx * step, -w / 2, view.width - 1 - w / 2), clamp(y + dy * step, -h / 2, view.height - 1 - h / 2), w, h];
    view.keys = at;
    tellKeys();
    view.draw();
  }

  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

  /** What a key does to the view; whether it did anything. */
  view.key = (event) => {
    const arrow = ARROWS[event.key];
    if (arrow && view.keys) moveKeys(...arrow, event);
    else if (arrow && view.zoom > 1 && document.activeElement === canvas) pan(-60 * arrow[0], -60 * arrow[1]);
    else if (event.key === "Enter" && view.keys) takeKeys(event.shiftKey);
    else if (event.key === "Escape") return view.cancel();
    else if (event.ctrlKey || event.metaKey || event.altKey) return false;
    else if (event.key === "b") view.startKeys();
    else if (event.key === "+" || event.key === "=") view.zoomBy(1.25);
    else if (event.key === "-") view.zoomBy(0.8);
    else if (event.key === "0") view.fit();
    else if (event.key === "f") toggleFullscreen(canvas.parentElement);
    else return false;
    return true;
  };

  function takeKeys(more) {
    const box = view.keys;
    view.keys = null;
    hooks.box(box, more);
    view.draw();
  }

  new ResizeObserver(() => view.draw()).observe(canvas);
  return view;
}

/** An outline with its label, in pixels of the frame. */
export function drawBox(pen, view, [x, y, w, h], label, colour, unit, { thick = false, dashed = false } = {}) {
  const width = (thick ? 3.5 : 2) * unit;
  pen.setLineDash(dashed ? [5 * unit, 5 * unit] : []);
  for (const [ink, wide] of [["rgb(0 0 0 / 45%)", width + 2 * unit], [colour, width]]) {
    pen.lineWidth = wide;
    pen.strokeStyle = ink;
    pen.strokeRect(x, y, w, h);
  }
  pen.setLineDash([]);
  if (!label) return;
  pen.font = `600 ${13 * unit}px system-ui, sans-serif`;
  const wide = pen.measureText(label).width + 10 * unit;
  const height = 20 * unit;
  const left = Math.min(Math.max(0, x - unit), view.width - wide);
  const top = y - height >= 0 ? y - height : Math.min(y + h, view.height - height);
  pen.fillStyle = colour;
  pen.fillRect(left, top, wide, height);
  pen.fillStyle = "#000";
  pen.fillText(label, left + 5 * unit, top + 14.5 * unit);
}

export function toggleFullscreen(place) {
  if (document.fullscreenElement) document.exitFullscreen();
  else if (place.requestFullscreen) place.requestFullscreen().catch(() => {});
}

/** The buttons over the image. */
export function wireTools(view) {
  byId("zoom-in").onclick = () => view.zoomBy(1.5);
  byId("zoom-out").onclick = () => view.zoomBy(1 / 1.5);
  byId("zoom-fit").onclick = view.fit;
  byId("keys-box").onclick = view.startKeys;
  byId("fullscreen").onclick = () => toggleFullscreen(byId("view"));
  byId("fullscreen").hidden = !document.fullscreenEnabled;
  byId("help-open").onclick = () => byId("help").showModal();
}

/** Dark, or light with high contrast: what was chosen last, else what the system prefers. */
export function wireTheme() {
  const bright = matchMedia("(prefers-color-scheme: light), (prefers-contrast: more)").matches;
  const apply = (theme) => {
    document.documentElement.dataset.theme = theme;
    byId("theme").textContent = theme === "light" ? "Dark" : "Light";
    byId("theme").setAttribute("aria-label", theme === "light" ? "dark theme" : "light theme with high contrast");
  };
  apply(localStorage.theme || (bright ? "light" : "dark"));
  byId("theme").onclick = () => {
    localStorage.theme = document.documentElement.dataset.theme === "light" ? "dark" : "light";
    apply(localStorage.theme);
  };
}

/** Whether a key is meant for what has the focus, and not for the page. */
export function typing(event) {
  const place = event.target;
  if (place.type === "range") return /^(Arrow|Page|Home|End)/.test(event.key);
  if (document.querySelector("dialog[open]") || /^(INPUT|TEXTAREA|SELECT)$/.test(place.tagName)) return true;
  return /^(BUTTON|A|SUMMARY)$/.test(place.tagName) && (event.key === "Enter" || event.key === " ");
}
