// Keeps a page fresh from one event stream. The page is complete without it.
const api = "/api/v1";
const link = document.getElementById("link");
const detail = document.querySelector("[data-page=job]");
const jobId = detail?.dataset.job;
const terminal = new Set(["cancelled", "failed", "dead", "succeeded"]);
const verbs = {
  queued: ["cancel", "pause"], running: ["cancel", "pause"], paused: ["resume", "cancel"],
  failed: ["retry"], dead: ["retry"], cancelled: ["retry"], succeeded: [],
};
const curves = new Map();
let reloading = 0;

function reloadSoon() { // once, however many events ask for it
  clearTimeout(reloading);
  reloading = setTimeout(() => location.reload(), 800);
}

const fixed = (value, digits) => (value === undefined || value === null ? null : Number(value).toFixed(digits));

function put(place, field, text) {
  const node = place.querySelector(`[data-field=${field}]`);
  if (node && text !== null && text !== undefined) node.textContent = text;
}

function showState(place, state) {
  const node = place.querySelector("[data-field=state]");
  node.textContent = state;
  node.className = `state ${state}`;
  if (state === "succeeded") place.querySelector("[data-field=bar]").value = 1;
}

function showProgress(place, event) {
  place.querySelector("[data-field=bar]").value = event.fraction;
  put(place, "steps", `${event.stage} ${event.step}/${event.steps}`);
  put(place, "eta", event.eta_seconds > 0 ? `${Math.ceil(event.eta_seconds)} s left` : "");
  put(place, "loss", fixed(event.loss, 4));
  put(place, "psnr", fixed(event.psnr, 2));
  put(place, "gaussians", event.gaussians);
}

function showVerbs(state) {
  for (const button of document.querySelectorAll("[data-verb]")) {
    button.hidden = !(verbs[state] ?? []).includes(button.dataset.verb);
  }
}

function draw(key) {
  const points = curves.get(key);
  if (points.length < 2) return;
  let figure = document.querySelector(`[data-curve="${CSS.escape(key)}"]`);
  if (!figure) {
    figure = document.createElement("figure");
    figure.dataset.curve = key;
    figure.innerHTML = '<svg viewBox="0 0 640 160" preserveAspectRatio="none" role="img"><polyline/></svg><figcaption></figcaption>';
    figure.querySelector("svg").setAttribute("aria-label", `${key} over training`);
    document.getElementById("curves").append(figure);
  }
  const values = points.map((p) => p[1]);
  const low = Math.min(...values), high = Math.max(...values), first = points[0][0];
  const span = points.at(-1)[0] - first || 1, scale = 152 / (high - low || 1);
  const path = points.map(([s, v]) => `${((s - first) / span) * 640},${156 - (v - low) * scale}`).join(" ");
  figure.querySelector("polyline").setAttribute("points", path);
  figure.querySelector("figcaption").textContent = `${key}: ${Number(values.at(-1)).toPrecision(4)}`;
}

function addPoint(event) {
  if (event.stage !== "train") return;
  for (const key of ["loss", "psnr", "gaussians"]) {
    if (event[key] === undefined) continue;
    const points = curves.get(key) ?? [];
    if (points.length && points.at(-1)[0] >= event.step) continue;
    points.push([event.step, event[key]]);
    curves.set(key, points);
    draw(key);
  }
}

function addNote(text) {
  const item = document.createElement("li");
  item.textContent = text;
  document.getElementById("notes").append(item);
}

function addPicture(event) {
  const url = `${api}/artifacts/${event.sha256}`;
  if (document.querySelector(`#pictures a[href="${url}"]`)) return;
  const figure = document.createElement("figure"), anchor = document.createElement("a");
  const image = document.createElement("img"), caption = document.createElement("figcaption");
  anchor.href = image.src = url;
  image.alt = caption.textContent = `${event.caption}, step ${event.step}`;
  anchor.append(image);
  figure.append(anchor, caption);
  document.getElementById("pictures").append(figure);
}

function take(message) {
  const event = JSON.parse(message.data);
  const place = document.querySelector(`[data-job="${event.job_id}"]`);
  if (!place) {
    if (!detail && event.kind === "state" && event.state === "queued") reloadSoon();
    return;
  }
  if (event.kind === "progress") showProgress(place, event);
  if (event.kind === "state") showState(place, event.state);
  if (event.kind === "state" && event.means) put(place, "psnr", fixed(event.means.psnr, 2));
  if (!detail) {
    if (event.kind === "state" && event.state === "succeeded") reloadSoon();
    return;
  }
  if (event.kind === "progress") addPoint(event);
  if (event.kind === "note") addNote(event.text);
  if (event.kind === "preview") addPicture(event);
  if (event.kind === "checkpointed") addNote(`checkpoint at step ${event.step}`);
  if (event.kind !== "state") return;
  showVerbs(event.state);
  if (event.reason) addNote(`${event.state}: ${event.reason.split("\n", 1)[0]}`);
  if (terminal.has(event.state) && event.id > Number(document.body.dataset.newest)) reloadSoon();
}

function listen() {
  const source = new EventSource(jobId ? `${api}/jobs/${jobId}/events` : `${api}/events?after=${document.body.dataset.newest}`);
  source.onopen = () => { link.textContent = "live"; link.classList.add("on"); };
  source.onerror = () => {
    link.classList.remove("on");
    if (detail && terminal.has(detail.querySelector("[data-field=state]").textContent)) source.close();  // told all
    link.textContent = source.readyState === EventSource.CLOSED ? "ended" : "reconnecting";
  };
  for (const kind of ["state", "progress", "note", "preview", "checkpointed"]) source.addEventListener(kind, take);
}

async function start() {
  if (detail) {
    showVerbs(detail.querySelector("[data-field=state]").textContent);
    const found = await (await fetch(`${api}/jobs/${jobId}/metrics`)).json();
    for (const [key, points] of Object.entries(found)) { curves.set(key, points); draw(key); }
    for (const button of document.querySelectorAll("[data-verb]")) {
      button.addEventListener("click", async () => {
        button.disabled = true;
        const reply = await fetch(`${api}/jobs/${jobId}/${button.dataset.verb}`, { method: "POST" });
        if (!reply.ok) addNote((await reply.json()).detail);
        button.disabled = false;
        if (reply.ok) reloadSoon();
      });
    }
  }
  listen();
}

start();
