// The recovered motion: a joint over time, and the paths of all joints over the readout of one frame, on its picture.
import { api } from "./live.js";
import { kilo, line, node, slug, ticks } from "./plot.js";

const root = document.querySelector("[data-motion]");
const find = (name) => root.querySelector(`[data-${name}]`);
const slim = matchMedia("(max-width: 46rem)");
const box = { width: 760, height: 300, left: 50, right: 10, top: 10, bottom: 34 };
const shown = { camera: null, frame: 0 };
let data = null, shutter = [];

const trainer = () => Object.keys(data.cameras).find((name) => data.cameras[name].training);

function instants(slots, height) { // what the method renders at: the slots' own instants within the readout
  return slots.map(([lo, hi, start, rate]) => ({ lo, hi, from: start + rate * lo, to: start + rate * hi, scans: rate !== 0, whole: lo === 0 && hi === height }));
}

function at(samples, offset, axis) { // a joint's coordinate at an instant of the readout, between the drawn ones
  const offsets = data.offsets_frames, span = offsets.at(-1) - offsets[0];
  if (!span) return samples[0][axis];
  const place = Math.min(Math.max((offset - offsets[0]) / span, 0), 1) * (offsets.length - 1);
  const low = Math.min(Math.floor(place), offsets.length - 2), part = place - low;
  return samples[low][axis] * (1 - part) + samples[low + 1][axis] * part;
}

function held(found, frame, joint, axis) { // bands: each holds one instant; blur and instant have no seams of rows
  const samples = found[frame].map((s) => s[joint]);
  const steps = shutter.filter((s) => !s.scans && !s.whole);
  return steps.map((s, i) => ({ from: i ? (steps[i - 1].from + s.from) / 2 : data.offsets_frames[0], to: i < steps.length - 1 ? (s.from + steps[i + 1].from) / 2 : data.offsets_frames.at(-1), value: at(samples, s.from, axis) }));
}

function drawTime() {
  box.width = slim.matches ? 380 : 760;
  const joint = Number(find("joint").value), axis = Number(find("axis").value), svg = find("time");
  const pick = (all) => all.map((frame) => frame.map((sample) => sample[joint][axis]));
  const found = pick(data.found), truth = data.truth && pick(data.truth);
  const values = [...found.flat(), ...(truth ?? []).flat()], low = Math.min(...values), high = Math.max(...values);
  const half = Math.max(data.period_frames, data.readout_frames) / 2, first = data.mid_frames[0] - half, last = data.mid_frames.at(-1) + half;
  const x = (t) => box.left + ((t - first) / (last - first)) * (box.width - box.left - box.right);
  const y = (v) => box.height - box.bottom - ((v - low) / (high - low || 1)) * (box.height - box.top - box.bottom);
  const parts = [], times = (frame) => data.offsets_frames.map((o) => data.mid_frames[frame] + o);
  data.mid_frames.forEach((mid, frame) => {
    const start = x(mid - data.readout_frames / 2), end = x(mid + data.readout_frames / 2);
    if (frame % 2 === 0 || frame === shown.frame) parts.push(node("rect", { class: `plot-window${frame === shown.frame ? " now" : ""}`, x: start, width: end - start, y: box.top, height: box.height - box.top - box.bottom }));
  });
  for (const tick of ticks(low, high, 5)) parts.push(node("line", { class: "plot-grid", x1: box.left, x2: box.width - box.right, y1: y(tick), y2: y(tick) }), node("text", { class: "plot-text", x: box.left - 7, y: y(tick) + 4, "text-anchor": "end" }, kilo(tick)));
  for (const tick of ticks(first, last, 7)) parts.push(node("text", { class: "plot-text", x: x(tick), y: box.height - 16, "text-anchor": "middle" }, kilo(tick)));
  parts.push(node("text", { class: "plot-text", x: box.width - box.right, y: box.height - 2, "text-anchor": "end" }, "time, source frames"), node("text", { class: "plot-text", x: box.left + 4, y: box.top + 10 }, "mm"));
  found.forEach((samples, frame) => {
    const path = line(times(frame).map((t, i) => [x(t), y(samples[i])]));
    const steps = held(data.found, frame, joint, axis);
    parts.push(node("path", { class: steps.length ? "plot-held" : "plot-found", d: path, fill: "none" }));
    for (const step of steps) parts.push(node("line", { class: "plot-found", x1: x(data.mid_frames[frame] + step.from), x2: x(data.mid_frames[frame] + step.to), y1: y(step.value), y2: y(step.value) }));
  });
  truth?.forEach((samples, frame) => parts.push(node("path", { class: "plot-truth", d: line(times(frame).map((t, i) => [x(t), y(samples[i])])) })));
  svg.setAttribute("viewBox", `0 0 ${box.width} ${box.height}`);
  svg.setAttribute("class", slug(root.dataset.method));
  svg.replaceChildren(...parts);
  const errors = truth ? data.found.flatMap((f, n) => f.map((s, i) => Math.hypot(...s[joint].map((v, k) => v - data.truth[n][i][joint][k])))) : null;
  const mean = errors && errors.reduce((a, b) => a + b, 0) / errors.length;
  svg.setAttribute("aria-label", `${data.joints[joint]} over time${mean === null ? "" : `, on average ${mean.toFixed(1)} mm from the true motion`}`);
}

function project(camera, point) {
  const [u, v, w] = camera.matrix.map((row) => row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3]);
  return [u / w, v / w];
}

function near(camera, frame, size) { // a square around the body, within the picture
  const all = [data.found, data.truth].filter(Boolean).flatMap((d) => d[frame].flat()).map((p) => project(camera, p));
  const xs = all.map((p) => p[0]), ys = all.map((p) => p[1]), [x0, x1, y0, y1] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const side = Math.min(Math.max(...size), 1.35 * Math.max(x1 - x0, y1 - y0));
  return { side, x: (x0 + x1 - side) / 2, y: (y0 + y1 - side) / 2 };
}

function drawView() {
  const name = data.cameras[shown.camera] ? shown.camera : trainer(), camera = data.cameras[name], frame = shown.frame;
  const kind = camera.training ? "input" : "truth", svg = find("overlay"), [width, height] = camera.size;
  const { side, x, y } = near(camera, frame, camera.size);
  const parts = [node("image", { href: `${api}/jobs/${root.dataset.source}/frames/${name}/${frame}/${kind}.png`, x: 0, y: 0, width, height })];
  const seams = camera.slots.filter(([lo, , , rate]) => !rate && lo);
  for (const [lo] of seams) parts.push(node("line", { class: "over-seam", x1: 0, x2: width, y1: lo, y2: lo }));
  const paths = (all, kindOf) => data.joints.forEach((_, joint) => parts.push(node("path", { class: kindOf, d: line(all[frame].map((s) => project(camera, s[joint]))) })));
  paths(data.found, "over-found");
  if (data.truth) paths(data.truth, "over-true");
  if (camera.training) data.joints.forEach((_, joint) => { // where a joint is when the scan reaches it
    const points = data.found[frame].map((s) => project(camera, s[joint]));
    const rows = data.offsets_frames.map((o) => ((o - camera.trigger_frames) / data.readout_frames + 0.5) * height);
    const i = points.findIndex((p, k) => k && (rows[k] - p[1]) * (rows[k - 1] - points[k - 1][1]) <= 0);
    if (i > 0) parts.push(node("circle", { class: "over-now", cx: points[i][0], cy: points[i][1], r: side / 90 }));
  });
  svg.setAttribute("viewBox", `${x} ${y} ${side} ${side}`);
  svg.setAttribute("aria-label", `Joint paths over the ${kind === "input" ? "rolling-shutter input" : "truth"} of camera ${name}, frame ${frame}`);
  svg.replaceChildren(...parts);
  find("view-caption").textContent = camera.training
    ? `Camera ${name}, frame ${frame}: paths over the readout; a dot is where the scan meets the joint.${seams.length ? " Blue: seams of the bands." : ""}`
    : `Camera ${name}, frame ${frame}: held out, so this is the truth; choose a training camera above to see the input.`;
}

function legend() {
  const add = (kind, text) => { const item = document.createElement("li"), mark = document.createElement("i"); mark.className = `swatch ${kind} ${slug(root.dataset.method)}`; item.append(mark, text); find("legend").append(item); };
  const steps = shutter.some((s) => !s.scans && !s.whole);
  add("found", steps ? "rendered instants" : "recovered");
  if (steps) add("held", "recovered path");
  if (data.truth) add("true", "true");
}

function draw() { drawTime(); drawView(); }

async function start() {
  const reply = await fetch(root.dataset.motion);
  if (!reply.ok) { root.textContent = "The paths cannot be read; load the page again."; return; }
  data = await reply.json();
  shutter = instants(data.cameras[trainer()].slots, data.cameras[trainer()].size[1]);
  shown.frame = Math.floor(data.found.length / 2);
  data.joints.forEach((name, i) => find("joint").add(new Option(name, i)));
  find("joint").value = Math.max(0, data.joints.indexOf("right wrist"));
  find("joint").onchange = find("axis").onchange = draw;
  legend();
  document.addEventListener("rs:view", (event) => { Object.assign(shown, event.detail); draw(); });
  slim.addEventListener("change", draw);
  draw();
}

start();
