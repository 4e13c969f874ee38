// Charts of stored benchmark results.
import { colour, draw, redraw } from "./charts.js";

const data = JSON.parse(document.querySelector("[data-data]")?.textContent ?? "{}");

function chart(root, title) {
  const figure = document.createElement("figure"), head = document.createElement("h3"), place = document.createElement("div");
  head.textContent = title;
  place.className = "chart";
  place.setAttribute("role", "img");
  place.setAttribute("aria-label", title);
  figure.append(head, place);
  root.append(figure);
  return place;
}

const by = (list, key) => { const found = new Map(); for (const item of list) { const k = key(item); if (!found.has(k)) found.set(k, []); found.get(k).push(item); } return found; };
const family = (way) => (way.label.startsWith("+") ? "scanline, refined" : way.way.startsWith("bands") || way.label.startsWith("bands") ? "bands, one pass" : way.label.replace(/[,:(].*$/, "").trim());
const alone = (name) => !["bands, one pass", "the paper's way"].includes(name);

function render(root, result) {
  const main = result.ways.filter((w) => w.motion_px === result.main_px), place = chart(root, `Error against run time, ${result.main_px} px of motion`);
  const traces = [...by(main, family)].map(([name, group]) => {
    const sorted = alone(name) ? group : [...group].sort((a, b) => a.bands - b.bands);
    return { x: sorted.map((w) => w.total_ms), y: sorted.map((w) => w.accuracy.psnr_db), text: sorted.map((w) => w.label), name, mode: alone(name) ? "markers" : "lines+markers", marker: { size: 11 }, hovertemplate: "%{text}<br>%{x:.1f} ms, %{y:.1f} dB<extra></extra>" };
  });
  draw(place, traces, { x: { type: "log", title: { text: "forward and backward, ms" } }, y: { title: { text: "PSNR to the exact image, dB" } } });
  if (!result.orders?.length) return;
  const orders = chart(root, "Error of T bands falls as 1 / T");
  draw(orders, result.orders.map((o) => ({ x: o.bands, y: o.rms_error, name: `${o.motion_px} px, order ${o.order.toFixed(2)}`, mode: "lines+markers" })), { x: { type: "log", title: { text: "T, bands" } }, y: { type: "log", title: { text: "RMS error" } } });
}

function growth(root, result) {
  const names = { gaussians: "Gaussians", pixels: "image side, px", bands: "T, bands", frames: "frames", memory: "T, bands" };
  for (const [axis, curves] of by(result.curves, (c) => c.axis)) {
    const memory = curves.every((c) => c.points.every((p) => p.memory_mb !== null && p.total_ms === null)), value = (p) => (memory ? p.memory_mb : p.total_ms ?? p.step_ms ?? p.memory_mb);
    const place = chart(root, `${memory ? "Memory" : "Time"} against ${names[axis] ?? axis}`);
    draw(place, curves.map((c) => ({ x: c.points.map((p) => p.x), y: c.points.map(value), name: c.name, mode: "lines+markers" })), { x: { type: "log", title: { text: names[axis] ?? axis } }, y: { type: "log", title: { text: memory ? "memory, MB" : "forward and backward, ms" } } });
  }
}

function train(root, result) {
  for (const { subject, curves } of result.subjects) {
    const place = chart(root, `Held-out PSNR against seconds, ${subject}`);
    draw(place, curves.map((c) => ({ x: c.seconds, y: c.psnr_db, name: c.method, mode: "lines+markers", line: { color: colour(c.method) } })), { x: { title: { text: "seconds of training" } }, y: { title: { text: "PSNR, dB" } } });
  }
}

const drawers = { render, growth, train };
function all() {
  for (const root of document.querySelectorAll("[data-benchmark]")) {
    root.replaceChildren();
    const kind = root.dataset.benchmark;
    try { drawers[kind]?.(root, data[kind]); } catch (error) { root.textContent = `This result has another shape than the page knows: ${error.message}`; }
  }
}
redraw(all);
addEventListener("load", all);
if (document.readyState === "complete") all();
