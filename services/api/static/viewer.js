// The avatar's page: one state, shown by the canvas, by the service's pictures and by the address.
import { parseScene } from "./posing.js";
import { SplatView, orbitCamera, slotsOf } from "./splats.js";

const page = document.querySelector("[data-viewer]"), api = page.dataset.viewer;
const at = (id) => document.getElementById(id);
const canvas = at("stage"), form = at("controls");
const SLIDERS = ["time", "readout", "azimuth", "elevation", "zoom"];
const FRAMES_A_SECOND = 6, TURN = 5, STEP = 0.1, SHARPEST = 1200, BLUR_INSTANTS = 10, RETRIES = 4, PAUSE = 1500;
let scene = null, view = null, playing = false, waiting = 0, last = 0, settled = 0;

const value = (id) => Number(at(id).value);
const shutter = () => new FormData(form).get("shutter");
const put = (id, number) => { const box = at(id); box.value = Math.min(Math.max(number, Number(box.min)), Number(box.max)); };
const turnBy = (degrees) => put("azimuth", ((value("azimuth") + degrees + 540) % 360) - 180);

function start(found) {
  scene = found;
  const time = at("time"), readout = at("readout");
  time.max = scene.frames - 1;
  time.value = time.dataset.value;
  readout.max = Math.max(scene.period, scene.readout);
  if (!("set" in readout.dataset)) readout.value = scene.readout;
  at("still-note").hidden = !scene.still;
  try {
    view = new SplatView(canvas, scene);
    canvas.hidden = false;
    at("poster").hidden = true;
    at("loading").hidden = true;
    canvas.addEventListener("webglcontextlost", (event) => { event.preventDefault(); fall("The graphics context was lost; the service draws instead."); });
  } catch (error) {
    fall("This browser has no WebGL 2; the service draws instead.");
  }
  new ResizeObserver(changed).observe(canvas);
  changed();
}

function fall(words) { // to the service's own pictures
  view = null;
  canvas.hidden = true;
  at("poster").hidden = false;
  at("loading").hidden = false;
  at("loading").textContent = words;
  changed();
}

function changed() {
  if (!waiting) waiting = requestAnimationFrame(show);
  clearTimeout(settled);
  settled = setTimeout(settle, 180);
}

function show(now) {
  waiting = 0;
  if (playing) {
    const next = value("time") + (Math.min(now - last, 100) / 1000) * FRAMES_A_SECOND;
    put("time", next > scene.frames - 1 ? 0 : next);
  }
  last = now;
  labels();
  if (view) draw();
  refresh();
  if (playing) waiting = requestAnimationFrame(show);
}

function draw() {
  const box = canvas.getBoundingClientRect(), scale = Math.min(devicePixelRatio || 1, SHARPEST / Math.max(box.width, box.height, 1));
  const width = Math.max(1, Math.round(box.width * scale)), height = Math.max(1, Math.round(box.height * scale));
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const word = shutter() === "blur" ? `blur:${BLUR_INSTANTS}` : shutter();
  const fit = Math.min(1, width / height); // the whole motion fits the narrower side
  const camera = orbitCamera(scene, value("azimuth"), value("elevation"), value("zoom") * fit);
  view.draw(camera, slotsOf(word, value("time"), value("readout") / scene.period), at("tint").checked ? 0.8 : 0);
  canvas.dataset.drawn = String(1 + Number(canvas.dataset.drawn || 0));
}

function labels() {
  const text = {
    time: `frame ${value("time").toFixed(2)} of ${scene.frames - 1}`,
    readout: `${value("readout").toFixed(1)} of ${scene.period} source frames`,
    azimuth: `${Math.round(value("azimuth"))}°`,
    elevation: `${Math.round(value("elevation"))}°`,
    zoom: `${value("zoom").toFixed(2)}×`,
  };
  for (const [id, words] of Object.entries(text)) {
    at(`${id}-out`).textContent = words;
    at(id).setAttribute("aria-valuetext", words);
  }
  at("clock").dataset.shutter = shutter().split(":")[0];
}

function query(more) {
  const words = new URLSearchParams();
  for (const id of SLIDERS) words.set(id, String(Math.round(value(id) * 1000) / 1000));
  for (const [key, word] of Object.entries(more)) words.set(key, word);
  return words;
}

// The service's pictures: one request at a time for each; what is asked meanwhile waits, and only the newest is kept.
const exposures = [...document.querySelectorAll("[data-exposure]")].map((image) => ({ image, word: image.dataset.exposure, busy: false, next: null, shown: "" }));
const poster = { image: at("poster"), busy: false, next: null, shown: "" };

function refresh(size = 256) {
  for (const each of exposures) ask(each, `${api}/render?${query({ shutter: each.word, size })}`);
  if (!view) ask(poster, `${api}/render?${query({ shutter: shutter(), size: 2 * size })}`);
}

function ask(each, url) {
  if (each.busy) { each.next = url; return; }
  if (each.shown === url) return;
  each.busy = true;
  each.image.classList.add("stale");
  const done = () => {
    each.busy = false;
    const next = each.next;
    each.next = null;
    if (next && next !== each.shown) ask(each, next);
    else each.image.classList.remove("stale");
  };
  const fresh = new Image();
  fresh.onload = () => { each.image.src = each.shown = url; each.failed = 0; at("trouble").hidden = true; done(); };
  fresh.onerror = () => { each.failed = (each.failed ?? 0) + 1; done(); trouble(each, url); };
  fresh.src = url;
}

async function trouble(each, url) { // tell why, and try again a few times: the process that draws may be starting
  if (each.failed <= RETRIES) setTimeout(settle, PAUSE * each.failed);
  const reply = await fetch(url).catch(() => null);
  if (reply?.ok) return;
  at("trouble").hidden = false;
  at("trouble").textContent = reply ? `The service cannot draw this: ${(await reply.json()).detail}` : "The service does not answer.";
}

function settle() { // what is dear or read aloud waits until the hand rests
  if (playing || !scene) return;
  refresh(448);
  const words = query({ shutter: shutter() });
  history.replaceState(null, "", `?${words}`);
  at("picture").href = `${api}/render?${query({ shutter: shutter(), size: 1024 })}`;
  at("posed").href = `${api}/export/ply?time=${words.get("time")}`;
  at("posed-time").textContent = `frame ${Number(words.get("time"))}`;
  at("said").textContent = `${shutter().replace(":", " ")} shutter, ${at("readout-out").textContent}, ${at("time-out").textContent}, azimuth ${at("azimuth-out").textContent}, elevation ${at("elevation-out").textContent}`;
}

function play(on) {
  playing = on;
  at("play").textContent = on ? "Pause" : "Play";
  at("play").setAttribute("aria-pressed", String(on));
  last = performance.now();
  changed();
}

const KEYS = {
  ArrowLeft: () => turnBy(TURN), ArrowRight: () => turnBy(-TURN),
  ArrowUp: () => put("elevation", value("elevation") + TURN), ArrowDown: () => put("elevation", value("elevation") - TURN),
  "+": () => put("zoom", value("zoom") * 1.1), "=": () => put("zoom", value("zoom") * 1.1), "-": () => put("zoom", value("zoom") / 1.1),
  ",": () => put("time", value("time") - STEP), ".": () => put("time", value("time") + STEP),
  " ": () => play(!playing), 0: reset,
};

function reset() {
  for (const [id, number] of Object.entries({ azimuth: 0, elevation: 0, zoom: 1 })) put(id, number);
  changed();
}

const fingers = new Map();
let spread = 0;

function moved(event) {
  const before = fingers.get(event.pointerId);
  if (!before) return;
  fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  if (fingers.size === 1) {
    const degrees = 220 / canvas.clientWidth;
    turnBy((before.x - event.clientX) * degrees);
    put("elevation", value("elevation") + (event.clientY - before.y) * degrees);
  } else {
    const [a, b] = [...fingers.values()], wide = Math.hypot(a.x - b.x, a.y - b.y);
    if (spread) put("zoom", (value("zoom") * wide) / spread);
    spread = wide;
  }
  changed();
}

canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, { x: event.clientX, y: event.clientY }); spread = 0; });
canvas.addEventListener("pointermove", moved);
for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, (event) => { fingers.delete(event.pointerId); spread = 0; });
canvas.addEventListener("wheel", (event) => {
  if (!event.ctrlKey && document.activeElement !== canvas) return; // the page scrolls until the stage is in focus
  event.preventDefault();
  put("zoom", value("zoom") * Math.exp(-event.deltaY / 600));
  changed();
}, { passive: false });
canvas.addEventListener("keydown", (event) => {
  const act = KEYS[event.key];
  if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
  event.preventDefault();
  act();
  changed();
});
form.addEventListener("input", changed);
form.addEventListener("submit", (event) => event.preventDefault());
at("play").addEventListener("click", () => play(!playing));
at("reset").addEventListener("click", reset);
at("copy").addEventListener("click", async () => {
  await navigator.clipboard.writeText(location.href);
  at("copy").textContent = "Copied";
});
at("turn").addEventListener("click", () => {
  const video = at("video"), button = at("turn");
  button.disabled = true;
  button.textContent = "Rendering …";
  video.src = `${api}/export/turntable?format=mp4`;
  video.preload = "auto"; // hidden, it would wait to be asked
  video.onloadedmetadata = () => { video.hidden = false; button.hidden = true; if (!matchMedia("(prefers-reduced-motion: reduce)").matches) video.play(); };
  video.onerror = () => { button.disabled = false; button.textContent = "It could not be made; try again"; };
});
document.documentElement.classList.add("scripted");

try {
  const reply = await fetch(`${api}/scene`);
  if (!reply.ok) throw new Error((await reply.json()).detail);
  start(parseScene(await reply.arrayBuffer()));
} catch (error) {
  at("loading").textContent = `The avatar cannot be shown: ${error.message}`;
}
