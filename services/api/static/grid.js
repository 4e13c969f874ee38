// The charts of a grid: parallel coordinates that can be brushed, and run time against error with its Pareto front.
import { colour, draw as plot, redraw } from "./charts.js";
import { kilo, line, node, slug } from "./plot.js";

const page = document.querySelector("[data-page=grid]");
const lessIsBetter = new Set(["flip", "lpips", "joint_mm", "sub_frame_joint_mm", "train_seconds"]);
const chosen = new Map(); // axis -> value
let data = null;

const read = () => JSON.parse(page.querySelector("[data-data]").textContent);
const metric = () => new URLSearchParams(location.search).get("metric") ?? "psnr";

function axes() {
  const words = Object.entries(data.words).map(([name, values]) => ({ name, values, of: (job) => job.words[name] }));
  const measured = ["train_seconds", metric()].filter((key, i, all) => all.indexOf(key) === i && data.jobs.some((job) => job.metrics[key] !== null));
  return [...words, ...measured.map((key) => {
    const found = data.jobs.map((job) => job.metrics[key]).filter((v) => v !== null);
    return { name: data.metrics[key], low: Math.min(...found), high: Math.max(...found), of: (job) => job.metrics[key], less: lessIsBetter.has(key) };
  })];
}

function parallel() {
  const place = page.querySelector("[data-parallel]"), all = axes();
  const done = data.jobs.filter((job) => job.metrics[metric()] !== null);
  if (!done.length || all.length < 2) { place.textContent = "The lines appear with the first results."; place.className = "parallel quiet"; return; }
  place.className = "parallel";
  const width = Math.max(place.clientWidth, 150 * all.length), height = 340, left = 12, right = 70, top = 40, bottom = 20;
  const x = (i) => left + (i * (width - left - right)) / (all.length - 1);
  const y = (axis, job) => {
    const value = axis.of(job);
    const part = axis.values ? (axis.values.length > 1 ? axis.values.indexOf(value) / (axis.values.length - 1) : 0.5) : (axis.high > axis.low ? (value - axis.low) / (axis.high - axis.low) : 0.5);
    return axis.values || axis.less ? top + part * (height - top - bottom) : height - bottom - part * (height - top - bottom);
  };
  const svg = node("svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-label": `Parallel coordinates of ${done.length} jobs over ${all.map((a) => a.name).join(", ")}` });
  for (const job of done) {
    const path = node("path", { class: slug(job.method), d: line(all.map((axis, i) => [x(i), y(axis, job)])) });
    path.classList.toggle("off", [...chosen].some(([name, value]) => job.words[name] !== value));
    path.append(node("title", {}, `${Object.values(job.words).join(", ")}: ${kilo(job.metrics[metric()])}`));
    svg.append(path);
  }
  all.forEach((axis, i) => {
    const end = i === all.length - 1 ? "end" : i ? "middle" : "start", shift = i === all.length - 1 ? 60 : 0;
    svg.append(node("line", { x1: x(i), x2: x(i), y1: top, y2: height - bottom }), node("text", { class: "axis-name", x: x(i) + shift, y: 16, "text-anchor": end }, axis.name));
    if (!axis.values) for (const [value, at] of [[axis.high, axis.less ? height - bottom : top], [axis.low, axis.less ? top : height - bottom]]) svg.append(node("text", { x: x(i) + 8, y: at + 4 }, kilo(value)));
    else axis.values.forEach((value, k) => {
      const label = node("text", { class: `value${chosen.get(axis.name) === value ? " on" : ""}`, x: x(i) + 8, y: top + (axis.values.length > 1 ? k / (axis.values.length - 1) : 0.5) * (height - top - bottom) + 4, tabindex: 0, role: "button", "aria-pressed": chosen.get(axis.name) === value }, value);
      const press = () => { if (chosen.get(axis.name) === value) chosen.delete(axis.name); else chosen.set(axis.name, value); parallel(); };
      label.addEventListener("click", press);
      label.addEventListener("keydown", (e) => { if (e.key === "Enter" || e.key === " ") { e.preventDefault(); press(); } });
      svg.append(label);
    });
  });
  place.replaceChildren(svg);
}

const mean = (values) => values.reduce((a, b) => a + b, 0) / values.length;
const deviation = (values) => (values.length > 1 ? Math.sqrt(values.reduce((s, v) => s + (v - mean(values)) ** 2, 0) / (values.length - 1)) : 0);

function points() { // seeds of one place together
  const groups = new Map();
  for (const job of data.jobs) {
    const value = job.metrics[metric()], seconds = job.metrics.train_seconds;
    if (value === null || seconds === null) continue;
    const words = Object.entries(job.words).filter(([name]) => name !== "seed"), name = `${job.method}|${words.map(([, v]) => v).join(", ")}`;
    if (!groups.has(name)) groups.set(name, { method: job.method, label: words.map(([k, v]) => `${k} ${v}`).join("<br>") || job.method, values: [], seconds: [] });
    groups.get(name).values.push(value);
    groups.get(name).seconds.push(seconds);
  }
  return [...groups.values()].map((g) => ({ ...g, x: mean(g.seconds), y: mean(g.values), dx: deviation(g.seconds), dy: deviation(g.values) }));
}

function front(all, less) {
  let best = less ? Infinity : -Infinity;
  return [...all].sort((a, b) => a.x - b.x).filter((p) => { const wins = less ? p.y < best : p.y > best; if (wins) best = p.y; return wins; });
}

function pareto() {
  const place = page.querySelector("[data-pareto]");
  if (!place) return;
  const all = points(), key = metric() === "train_seconds" ? "psnr" : metric();
  if (!all.length) { place.textContent = "The scatter appears with the first results."; place.classList.add("quiet"); return; }
  place.classList.remove("quiet");
  const methods = [...new Set(all.map((p) => p.method))], edge = front(all, lessIsBetter.has(key));
  const traces = [{ x: edge.map((p) => p.x), y: edge.map((p) => p.y), mode: "lines", line: { color: colour("oracle"), width: 1.5, dash: "dot", shape: lessIsBetter.has(key) ? "hv" : "hv" }, name: "Pareto front", hoverinfo: "skip" }];
  for (const method of methods) {
    const own = all.filter((p) => p.method === method);
    traces.push({ x: own.map((p) => p.x), y: own.map((p) => p.y), error_x: { array: own.map((p) => p.dx), thickness: 1, width: 2 }, error_y: { array: own.map((p) => p.dy), thickness: 1, width: 2 }, text: own.map((p) => p.label), mode: "markers", name: method, marker: { color: colour(method), size: 11, line: { width: 1.5, color: "rgba(255,255,255,.7)" } }, hovertemplate: "%{text}<br>%{x:.1f} s, %{y:.4g}<extra></extra>" });
  }
  plot(place, traces, { x: { title: { text: "training, s" } }, y: { title: { text: data.metrics[key] }, autorange: lessIsBetter.has(key) ? "reversed" : true } });
}

async function again() { // the page's data block is not a marked region: it changes with every result
  const reply = await fetch(location.href);
  const fresh = new DOMParser().parseFromString(await reply.text(), "text/html").querySelector("[data-data]");
  page.querySelector("[data-data]").textContent = fresh.textContent;
  draw();
}

function draw() { data = read(); parallel(); pareto(); }

document.addEventListener("rs:fresh", again);
addEventListener("resize", parallel);
redraw(draw);
addEventListener("load", draw);
if (document.readyState === "complete") draw();
