// Two pictures under one slider, and all pictures of the view below them, zoomed and moved together.
import { api, tell } from "./live.js";

const words = { input: "input (rolling shutter)", exposed: "as its shutter predicts", result: "result", truth: "truth", error: "error × 4" };
const gain = 4; // of the error map
const inferno = [[0, 0, 4], [40, 11, 84], [101, 21, 110], [159, 42, 99], [212, 72, 66], [245, 125, 21], [250, 193, 39], [252, 255, 164]];

function shade(value) {
  const place = Math.min(1, value) * (inferno.length - 1), low = Math.min(Math.floor(place), inferno.length - 2), part = place - low;
  return inferno[low].map((c, i) => Math.round(c + (inferno[low + 1][i] - c) * part));
}

const pictures = new Map(); // address -> promise of an image, so that scrubbing back is instant
function load(url) {
  if (!pictures.has(url)) {
    if (pictures.size > 400) pictures.delete(pictures.keys().next().value);
    pictures.set(url, new Promise((done, fail) => {
      const image = new Image();
      image.onload = () => done(image);
      image.onerror = () => { pictures.delete(url); fail(new Error(`${url} cannot be read`)); };
      image.src = url;
    }));
  }
  return pictures.get(url);
}

class Look {
  constructor(root) {
    this.root = root;
    this.jobs = JSON.parse(root.querySelector("[data-jobs]").textContent);
    this.find = (name) => root.querySelector(`[data-${name}]`);
    this.stage = this.find("stage");
    this.camera = root.dataset.camera;
    this.frame = Number(root.dataset.frame);
    this.layer = { left: root.dataset.left, right: root.dataset.right };
    this.view = { scale: 1, x: 0, y: 0 }; // of the picture, in pixels of the stage
    this.drawn = 0;
    this.sides = new Map();
  }

  async start() {
    const note = this.find("note");
    try {
      const all = await Promise.all(this.jobs.map(async (job) => (await fetch(`${api}/jobs/${job.id}/frames`)).json()));
      this.views = new Map(this.jobs.map((job, i) => [job.id, new Map(all[i].map((v) => [v.camera, v]))]));
      if (![...this.views.values()].some((v) => v.size)) throw new Error("no pictures were kept");
    } catch (error) {
      note.textContent = `The pictures cannot be loaded: ${error.message}. Load the page again.`;
      return;
    }
    this.controls();
    await this.show();
    note.textContent = "";
  }

  cameras() { return [...new Set([...this.views.values()].flatMap((v) => [...v.keys()]))].sort(); }

  layers() { // what can be shown of this camera, as job:kind
    const found = [];
    this.jobs.forEach((job, i) => {
      const kinds = this.views.get(job.id)?.get(this.camera)?.kinds ?? [];
      for (const kind of kinds) {
        if ((kind === "input" || kind === "truth") && found.some((f) => f.kind === kind)) continue;
        const shared = kind === "input" || kind === "truth";
        found.push({ value: `${job.id}:${kind}`, job: job.id, kind, title: shared ? words[kind] : `${job.title}: ${words[kind]}` });
      }
      if (kinds.includes("result") && found.some((f) => f.kind === "truth")) found.push({ value: `${job.id}:error`, job: job.id, kind: "error", title: `${job.title}: ${words.error}` });
    });
    return found;
  }

  url(job, kind) { return `${api}/jobs/${job}/frames/${this.camera}/${this.frame}/${kind}.png`; }

  truthUrl() { const l = this.layers().find((f) => f.kind === "truth"); return l && this.url(l.job, "truth"); }

  controls() {
    const select = this.find("camera-select"), range = this.find("frame-range");
    for (const camera of this.cameras()) {
      const trains = [...this.views.values()].some((v) => v.get(camera)?.kinds.includes("input"));
      select.add(new Option(`${camera} · ${trains ? "training" : "held out"}`, camera));
    }
    select.value = this.camera;
    select.onchange = () => this.go(select.value, this.frame);
    range.oninput = () => this.go(this.camera, Number(range.value));
    for (const side of ["left", "right"]) {
      this.root.querySelector(`[data-layer=${side}]`).onchange = (e) => { this.layer[side] = e.target.value; this.show(); };
    }
    this.find("wipe").oninput = () => this.cut();
    this.find("zoom").oninput = (e) => this.zoom(Number(e.target.value));
    this.pointer();
    new ResizeObserver(() => this.place()).observe(this.stage);
    document.addEventListener("rs:show", (e) => { this.go(e.detail.camera, e.detail.frame); this.stage.scrollIntoView({ block: "nearest", behavior: "smooth" }); });
  }

  pointer() {
    let from = null;
    this.stage.onpointerdown = (e) => {
      this.stage.setPointerCapture(e.pointerId);
      const box = this.stage.getBoundingClientRect(), at = (e.clientX - box.left) / box.width * 100;
      const grabs = this.view.scale === 1 || Math.abs(at - Number(this.find("wipe").value)) < 4;
      from = { grabs, x: e.clientX, y: e.clientY, view: { ...this.view } };
      if (grabs) this.wipeTo(at); else this.stage.classList.add("panning");
    };
    this.stage.onpointermove = (e) => {
      if (!from) return;
      const box = this.stage.getBoundingClientRect();
      if (from.grabs) { this.wipeTo((e.clientX - box.left) / box.width * 100); return; }
      this.view = { ...from.view, x: from.view.x + e.clientX - from.x, y: from.view.y + e.clientY - from.y };
      this.place();
    };
    this.stage.onpointerup = this.stage.onpointercancel = () => { from = null; this.stage.classList.remove("panning"); };
    this.stage.addEventListener("wheel", (e) => {
      if (!e.ctrlKey && !e.metaKey) return; // a plain wheel scrolls the page
      e.preventDefault();
      const box = this.stage.getBoundingClientRect();
      this.zoom(Math.min(8, Math.max(1, this.view.scale * Math.exp(-e.deltaY / 200))), e.clientX - box.left, e.clientY - box.top);
    }, { passive: false });
  }

  wipeTo(percent) { this.find("wipe").value = percent; this.cut(); }

  zoom(scale, x = this.stage.clientWidth / 2, y = this.stage.clientHeight / 2) {
    const old = this.view, part = scale / old.scale;
    this.view = { scale, x: x - (x - old.x) * part, y: y - (y - old.y) * part };
    this.find("zoom").value = scale;
    this.place();
  }

  async go(camera, frame) {
    const known = [...this.views.values()].find((v) => v.has(camera));
    if (!known) return;
    const frames = known.get(camera).frames;
    this.camera = camera;
    this.frame = frames.includes(frame) ? frame : frames[0];
    await this.show();
  }

  async show() {
    const turn = ++this.drawn, layers = this.layers(), range = this.find("frame-range");
    const frames = [...this.views.values()].find((v) => v.has(this.camera)).get(this.camera).frames;
    Object.assign(range, { min: frames[0], max: frames.at(-1) });
    range.value = this.frame;
    this.find("frame-out").textContent = this.frame;
    this.find("camera-select").value = this.camera;
    for (const [side, fallback] of [["left", "result"], ["right", "truth"]]) {
      if (!layers.some((l) => l.value === this.layer[side])) {
        const kind = this.layer[side].split(":")[1];
        this.layer[side] = (layers.find((l) => l.kind === kind) ?? layers.find((l) => l.kind === fallback) ?? layers[0]).value;
      }
      const select = this.root.querySelector(`[data-layer=${side}]`);
      select.replaceChildren(...layers.map((l) => new Option(l.title, l.value, false, l.value === this.layer[side])));
    }
    try {
      await Promise.all(["left", "right"].map((side) => this.fill(side, layers.find((l) => l.value === this.layer[side]), turn)));
      this.find("note").textContent = "";
    } catch (error) { this.find("note").textContent = error.message; }
    if (turn !== this.drawn) return;
    const whole = layers.find((l) => l.kind === "truth") ?? layers.find((l) => l.kind === "result") ?? layers[0];
    this.frameBody(await load(this.url(whole.job, whole.kind)));
    if (turn !== this.drawn) return;
    this.strip(layers);
    this.place();
    tell("rs:view", { camera: this.camera, frame: this.frame });
    for (const near of [this.frame + 1, this.frame - 1]) {
      if (!frames.includes(near)) continue;
      for (const side of ["left", "right"]) {
        const [job, kind] = this.layer[side].split(":");
        if (kind !== "error") load(`${api}/jobs/${job}/frames/${this.camera}/${near}/${kind}.png`).catch(() => {});
      }
    }
  }

  async fill(side, layer, turn) {
    const pane = this.root.querySelector(`[data-pane=${side}]`), image = pane.querySelector("img"), canvas = pane.querySelector("canvas");
    const text = `${layer.title}, camera ${this.camera}, frame ${this.frame}`;
    this.root.querySelector(`[data-tag=${side}]`).textContent = layer.title;
    const isError = layer.kind === "error";
    const first = await load(this.url(layer.job, isError ? "result" : layer.kind));
    const second = isError ? await load(this.truthUrl()) : null;
    if (turn !== this.drawn) return;
    this.size = [first.naturalWidth, first.naturalHeight];
    if (isError) { this.difference(canvas, first, second); canvas.setAttribute("aria-label", text); }
    else { image.src = first.src; image.alt = text; }
    image.hidden = isError;
    canvas.hidden = !isError;
    const names = ["left", "right"].map((s) => this.root.querySelector(`[data-tag=${s}]`).textContent);
    this.find("wipe").setAttribute("aria-label", `Wipe between ${names[0]} and ${names[1]}`);
  }

  difference(canvas, one, other) {
    const [width, height] = this.size;
    Object.assign(canvas, { width, height });
    const context = canvas.getContext("2d", { willReadFrequently: true });
    const read = (image) => { context.drawImage(image, 0, 0); return context.getImageData(0, 0, width, height); };
    const a = read(one), b = read(other);
    for (let i = 0; i < a.data.length; i += 4) {
      const error = (Math.abs(a.data[i] - b.data[i]) + Math.abs(a.data[i + 1] - b.data[i + 1]) + Math.abs(a.data[i + 2] - b.data[i + 2])) / 765;
      const [r, g, bl] = shade(error * gain);
      a.data[i] = r; a.data[i + 1] = g; a.data[i + 2] = bl; a.data[i + 3] = 255;
    }
    context.putImageData(a, 0, 0);
  }

  fitted(width, height) { // the body in the middle, with the scale of the camera's largest one so far
    const { side, x, y } = this.body, scale = Math.min(width, height) / side;
    return { scale, x: width / 2 - x * scale, y: height / 2 - y * scale };
  }

  frameBody(image) { // pictures are black where nobody is
    const [width, height] = this.size, small = document.createElement("canvas"), n = 96;
    Object.assign(small, { width: n, height: n });
    const context = small.getContext("2d", { willReadFrequently: true });
    context.drawImage(image, 0, 0, n, n);
    const { data } = context.getImageData(0, 0, n, n), box = [n, n, -1, -1];
    for (let i = 0; i < n * n; i++) {
      if (data[4 * i] + data[4 * i + 1] + data[4 * i + 2] < 36) continue;
      const x = i % n, y = Math.floor(i / n);
      box[0] = Math.min(box[0], x); box[1] = Math.min(box[1], y); box[2] = Math.max(box[2], x + 1); box[3] = Math.max(box[3], y + 1);
    }
    const all = { side: Math.max(width, height), x: width / 2, y: height / 2 };
    if (box[2] < 0) { this.body = all; return; }
    const [x0, x1] = [box[0], box[2]].map((v) => v / n * width), [y0, y1] = [box[1], box[3]].map((v) => v / n * height);
    const side = Math.min(all.side, Math.max(this.sides.get(this.camera) ?? 0, 1.18 * Math.max(x1 - x0, y1 - y0)));
    this.sides.set(this.camera, side);
    this.body = { side, x: (x0 + x1) / 2, y: (y0 + y1) / 2 };
  }

  place() {
    if (!this.body) return;
    const { clientWidth: w, clientHeight: h } = this.stage, base = this.fitted(w, h), v = this.view;
    if (v.scale === 1) { v.x = 0; v.y = 0; }
    v.x = Math.min(0, Math.max(w - w * v.scale, v.x));
    v.y = Math.min(0, Math.max(h - h * v.scale, v.y));
    const matrix = `translate(${v.x + base.x * v.scale}px, ${v.y + base.y * v.scale}px) scale(${base.scale * v.scale})`;
    for (const pane of this.stage.querySelectorAll(".pane")) {
      pane.classList.toggle("crisp", base.scale * v.scale > 9);
      for (const node of pane.children) node.style.transform = matrix;
    }
    this.stage.classList.toggle("zoomed", v.scale > 1);
    this.find("zoom-out").textContent = `${v.scale.toFixed(v.scale % 1 ? 2 : 0)}×`;
    for (const pane of this.root.querySelectorAll(".thumb-pane")) {
      const side = pane.clientWidth, own = this.fitted(side, side), image = pane.querySelector("img");
      image.style.transform = `translate(${(v.x / w) * side + own.x * v.scale}px, ${(v.y / h) * side + own.y * v.scale}px) scale(${own.scale * v.scale})`;
    }
    this.cut();
  }

  cut() {
    const at = Number(this.find("wipe").value);
    this.root.querySelector(".over").style.clipPath = `inset(0 ${100 - at}% 0 0)`;
    this.root.querySelector(".divider").style.left = `${at}%`;
  }

  strip(layers) {
    const list = this.find("strip"), shown = layers.filter((l) => l.kind !== "error");
    list.replaceChildren(...shown.map((layer) => {
      const item = document.createElement("li"), button = document.createElement("button");
      const pane = document.createElement("span"), image = document.createElement("img"), caption = document.createElement("span");
      button.type = "button";
      button.setAttribute("aria-pressed", String(layer.value === this.layer.left));
      pane.className = "thumb-pane";
      image.src = this.url(layer.job, layer.kind);
      image.alt = "";
      caption.className = "cap";
      caption.textContent = layer.title;
      pane.append(image);
      button.append(pane, caption);
      button.onclick = () => { this.layer.left = layer.value; this.show(); };
      item.append(button);
      return item;
    }));
  }
}

for (const root of document.querySelectorAll("[data-look]")) new Look(root).start();
