// Training curves of one or more jobs, growing while they train.
import { api, whole } from "./live.js";
import { kilo, line, node, slug, ticks } from "./plot.js";

const root = document.querySelector("[data-curves]");
const ids = JSON.parse(root.dataset.curves), names = JSON.parse(root.dataset.names), methods = JSON.parse(root.dataset.methods);
const titles = { psnr: "PSNR of the training view, dB", loss: "Loss", gaussians: "Gaussians" };
const found = new Map(); // key -> job id -> points
const box = { width: 380, height: 165, left: 40, right: 14, top: 8, bottom: 24 };
let waiting = false;

function smooth(points) { // a mean over neighbours: one step sees one picture, so raw values jump
  const reach = Math.max(1, Math.round(points.length / 60));
  return points.map(([step], i) => {
    const near = points.slice(Math.max(0, i - reach), i + reach + 1);
    return [step, near.reduce((sum, p) => sum + p[1], 0) / near.length];
  });
}

function draw(key) {
  const all = [...found.get(key).entries()].filter(([, points]) => points.length > 1);
  if (!all.length) return;
  let figure = root.querySelector(`[data-curve="${key}"]`);
  if (!figure) {
    figure = document.createElement("figure");
    figure.className = "curve";
    figure.dataset.curve = key;
    figure.append(node("svg", { viewBox: `0 0 ${box.width} ${box.height}`, role: "img" }), document.createElement("figcaption"));
    root.append(figure);
  }
  const drawn = all.map(([id, points]) => [id, key === "gaussians" ? points : smooth(points)]);
  const values = drawn.flatMap(([, points]) => points.map((p) => p[1]));
  const steps = drawn.flatMap(([, points]) => [points[0][0], points.at(-1)[0]]);
  const low = Math.min(...values), high = Math.max(...values), first = Math.min(...steps), last = Math.max(...steps);
  const x = (s) => box.left + ((s - first) / (last - first || 1)) * (box.width - box.left - box.right);
  const y = (v) => box.height - box.bottom - ((v - low) / (high - low || 1)) * (box.height - box.top - box.bottom);
  const parts = [];
  for (const tick of ticks(low, high, 4)) parts.push(node("line", { class: "plot-grid", x1: box.left, x2: box.width - box.right, y1: y(tick), y2: y(tick) }), node("text", { class: "plot-text", x: box.left - 6, y: y(tick) + 4, "text-anchor": "end" }, kilo(tick)));
  for (const tick of ticks(first, last, 5)) parts.push(node("text", { class: "plot-text", x: x(tick), y: box.height - 6, "text-anchor": "middle" }, kilo(tick)));
  for (const [id, points] of drawn) parts.push(node("path", { class: `plot-line ${slug(methods[ids.indexOf(id)])}`, d: line(points.map(([s, v]) => [x(s), y(v)])) }));
  const svg = figure.querySelector("svg"), end = all[0][1].at(-1)[1];
  svg.replaceChildren(...parts);
  svg.setAttribute("aria-label", `${titles[key] ?? key} over steps, from ${kilo(drawn[0][1][0][1])} to ${kilo(drawn[0][1].at(-1)[1])}`);
  const caption = figure.querySelector("figcaption"), now = document.createElement("b");
  caption.textContent = titles[key] ?? key;
  if (ids.length === 1) { now.textContent = key === "gaussians" ? whole(end) : kilo(end); caption.append(" ", now); }
}

function add(event) {
  if (event.kind !== "progress" || event.stage !== "train" || !ids.includes(event.job_id)) return;
  for (const key of Object.keys(titles)) {
    if (event[key] === undefined) continue;
    if (!found.has(key)) found.set(key, new Map());
    const points = found.get(key).get(event.job_id) ?? [];
    if (points.length && points.at(-1)[0] >= event.step) continue;
    points.push([event.step, event[key]]);
    found.get(key).set(event.job_id, points);
  }
  if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; for (const key of found.keys()) draw(key); rest(); }); }
}

function rest() {
  const none = !root.querySelector("figure");
  root.querySelector(".quiet-curves")?.remove();
  if (!none) return;
  const text = document.createElement("p");
  text.className = "quiet-curves";
  text.textContent = "The curves begin with the first steps.";
  root.append(text);
}

async function read() {
  await Promise.all(ids.map(async (id) => {
    const reply = await fetch(`${api}/jobs/${id}/metrics`);
    if (!reply.ok) return;
    const keys = await reply.json();
    for (const key of Object.keys(titles)) {
      if (!keys[key]) continue;
      if (!found.has(key)) found.set(key, new Map());
      found.get(key).set(id, keys[key]);
    }
  }));
  for (const key of Object.keys(titles)) if (found.has(key)) draw(key);
  rest();
  if (ids.length > 1) {
    const legend = document.createElement("ul");
    legend.className = "legend";
    ids.forEach((_, i) => { const item = document.createElement("li"), dot = document.createElement("i"); dot.className = `dot ${slug(methods[i])}`; item.append(dot, names[i]); legend.append(item); });
    root.before(legend);
  }
}

document.addEventListener("rs:event", (event) => add(event.detail));
read();
