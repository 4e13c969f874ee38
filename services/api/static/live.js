// Keeps a page fresh from one event stream: progress goes straight into its row, everything else asks the server for
// the marked regions again. The page is complete without it.
export const api = "/api/v1";
const terminal = new Set(["cancelled", "failed", "dead", "succeeded"]);
const verbs = {
  queued: ["cancel", "pause"], running: ["cancel", "pause"], paused: ["resume", "cancel"],
  failed: ["retry"], dead: ["retry"], cancelled: ["retry"], succeeded: [],
};
const pause = 1500; // between two refreshes, ms
const thin = "\u202f";
let refreshing = 0, refreshed = 0;

export const fixed = (value, digits) => (value === undefined || value === null ? null : Number(value).toFixed(digits));
export const whole = (value) => String(Math.round(value)).replace(/\B(?=(\d{3})+$)/g, thin);

export function duration(seconds) {
  if (seconds < 60) return `${seconds < 10 ? seconds.toFixed(1) : Math.round(seconds)} s`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ${Math.round(seconds % 60)} s`;
  return `${Math.floor(seconds / 3600)} h ${Math.round((seconds % 3600) / 60)} min`;
}

export function send(path, options = {}) {
  const csrf = document.querySelector("meta[name=csrf]")?.content;
  const headers = { ...(csrf ? { "X-CSRF-Token": csrf } : {}), ...options.headers };
  return fetch(path, { method: "POST", ...options, headers });
}

export async function reasonOf(reply) {
  try { return (await reply.json()).detail; } catch { return `${reply.status} ${reply.statusText}`; }
}

export function toast(text) {
  const place = document.querySelector("[data-toast]");
  if (!place) return;
  place.textContent = text;
  place.hidden = false;
  setTimeout(() => { place.hidden = true; }, 6000);
}

export const tell = (name, detail) => document.dispatchEvent(new CustomEvent(name, { detail }));

function put(place, field, text) {
  const node = place.querySelector(`[data-field=${field}]`);
  if (node && text !== null && text !== undefined) node.textContent = text;
}

function showState(place, state) {
  const node = place.querySelector("[data-field=state]");
  if (!node) return;
  node.textContent = state;
  node.className = `state ${state}`;
  place.dataset.state = state;
}

function showProgress(place, event) {
  const bar = place.querySelector("[data-field=bar]");
  if (bar) bar.value = event.fraction;
  put(place, "steps", `${event.stage} ${whole(event.step)} / ${whole(event.steps)}`);
  put(place, "eta", event.eta_seconds > 0 ? `${duration(event.eta_seconds)} left` : "");
  put(place, "loss", fixed(event.loss, 4));
  put(place, "psnr", fixed(event.psnr, 2));
  if (event.gaussians) put(place, "gaussians", whole(event.gaussians));
}

function swap(old, fresh) {
  const open = [...old.querySelectorAll("details")].map((d) => d.open);
  fresh.querySelectorAll("details").forEach((d, i) => { if (open[i]) d.open = true; });
  const chosen = new Set([...old.querySelectorAll("input:checked")].map((i) => i.value));
  fresh.querySelectorAll("input[type=checkbox]").forEach((i) => { i.checked = chosen.has(i.value); });
  const held = old.contains(document.activeElement) ? document.activeElement : null;
  const again = held && (held.getAttribute("href") ? `[href="${CSS.escape(held.getAttribute("href"))}"]` : held.value ? `[value="${CSS.escape(held.value)}"]` : null);
  old.replaceWith(fresh);
  if (again) fresh.querySelector(again)?.focus();
}

export async function refresh() { // regions are matched by name, so their number may change
  refreshed = Date.now();
  const reply = await fetch(location.href, { headers: { accept: "text/html" } });
  if (!reply.ok) return;
  const page = new DOMParser().parseFromString(await reply.text(), "text/html");
  const missing = [...page.querySelectorAll("[data-fresh]")].some((n) => !document.querySelector(`[data-fresh="${n.dataset.fresh}"]`));
  const state = page.querySelector("[data-page=job]")?.dataset.state;
  if (missing || (state === "succeeded" && !document.querySelector("[data-heat]"))) { location.reload(); return; }
  for (const old of document.querySelectorAll("[data-fresh]")) {
    const fresh = page.querySelector(`[data-fresh="${old.dataset.fresh}"]`);
    if (fresh && fresh.outerHTML !== old.outerHTML) swap(old, document.adoptNode(fresh));
  }
  showVerbs();
  tell("rs:fresh", {});
}

export function refreshSoon() {
  clearTimeout(refreshing);
  refreshing = setTimeout(refresh, Math.max(120, pause - (Date.now() - refreshed)));
}

function showVerbs() {
  const job = document.querySelector("[data-page=job]");
  for (const button of job?.querySelectorAll("[data-verb]") ?? []) {
    button.hidden = !(verbs[job.dataset.state] ?? []).includes(button.dataset.verb);
  }
}

function take(message) {
  const event = JSON.parse(message.data);
  for (const place of document.querySelectorAll(`[data-job="${event.job_id}"]`)) {
    if (event.kind === "progress") showProgress(place, event);
    if (event.kind === "state") showState(place, event.state);
  }
  tell("rs:event", event);
  if (event.kind !== "progress") showVerbs();
  const isNew = event.id > Number(document.body.dataset.newest);
  if (isNew && event.kind === "state") refreshSoon();
}

function listen(jobId) {
  const link = document.getElementById("link");
  const say = (state, text) => { if (link) { link.hidden = false; link.dataset.link = state; link.textContent = text; } };
  const after = document.body.dataset.newest;
  const source = new EventSource(jobId ? `${api}/jobs/${jobId}/events?after=${after}` : `${api}/events?after=${after}`);
  source.onopen = () => say("on", "live");
  source.onerror = () => {
    const ended = jobId && terminal.has(document.querySelector("[data-page=job]").dataset.state);
    if (ended) source.close(); // everything has been told
    say(ended ? "off" : "wait", ended ? "ended" : "reconnecting");
  };
  for (const kind of ["state", "progress", "note", "preview", "checkpointed"]) source.addEventListener(kind, take);
  addEventListener("pagehide", () => source.close());
}

document.addEventListener("click", async (click) => {
  const button = click.target.closest("[data-verb]");
  if (!button) return;
  button.disabled = true;
  const id = button.closest("[data-job]").dataset.job;
  const reply = await send(`${api}/jobs/${id}/${button.dataset.verb}`);
  button.disabled = false;
  if (reply.ok) refreshSoon(); else toast(await reasonOf(reply));
});

showVerbs();
const job = document.querySelector("[data-page=job]");
const over = job && terminal.has(job.dataset.state);
if (!over && document.querySelector("[data-job],[data-fresh]")) listen(job?.dataset.job);
