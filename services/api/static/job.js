// What belongs to one job's page alone: the log's tail, notes of the job, and the heat map that opens a frame.
import { api, tell } from "./live.js";

const page = document.querySelector("[data-page=job]");
const log = document.querySelector("[data-log]");
let offset = null, reading = false;

async function tail() {
  if (reading) return;
  reading = true;
  const reply = await fetch(`${api}/jobs/${page.dataset.job}/log${offset === null ? "" : `?offset=${offset}`}`);
  if (reply.ok) {
    const text = await reply.text(), near = log.scrollHeight - log.scrollTop - log.clientHeight < 40;
    if (offset === null) log.textContent = "";
    offset = Number(reply.headers.get("x-next-offset"));
    if (text) log.append(text);
    if (!log.textContent) log.textContent = "The process wrote nothing: that is how it should be.\n";
    if (near) log.scrollTop = log.scrollHeight;
  }
  reading = false;
}

function say(event) {
  const text = event.kind === "note" ? event.text : event.kind === "checkpointed" ? `checkpoint at step ${event.step}` : event.kind === "state" ? `${event.state}${event.reason ? `: ${event.reason.split("\n", 1)[0]}` : ""}` : null;
  if (!text) return;
  if (log.textContent.startsWith("The process wrote") || log.textContent.startsWith("waiting")) log.textContent = "";
  log.append(`· ${text}\n`);
  log.scrollTop = log.scrollHeight;
}

async function history() { // notes so far: the stream of a finished job ends by itself
  const reply = await fetch(`${api}/jobs/${page.dataset.job}/events?after=0`, { signal: AbortSignal.timeout(4000) });
  if (reply.status !== 200) return;
  const reader = reply.body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  try {
    for (;;) {
      const { value, done } = await reader.read();
      if (done) break;
      const parts = (rest + value).split("\n\n");
      rest = parts.pop();
      for (const part of parts) {
        const data = part.split("\n").find((line) => line.startsWith("data: "));
        if (data) { const event = JSON.parse(data.slice(6)); if (event.id <= Number(document.body.dataset.newest)) say(event); else { reader.cancel(); return; } }
      }
      if (parts.some((part) => part.startsWith(": ping"))) { reader.cancel(); return; }
    }
  } catch { /* an open job's stream stays open; what was read is shown */ }
}

function pressed() {
  const cells = [...document.querySelectorAll("[data-heat] button")];
  for (const cell of cells) {
    const is = cell.dataset.camera === pressed.camera && Number(cell.dataset.frame) === pressed.frame;
    cell.setAttribute("aria-pressed", String(is));
    cell.tabIndex = is ? 0 : -1;
  }
  if (cells.length && !cells.some((cell) => cell.tabIndex === 0)) cells[0].tabIndex = 0;
}

document.addEventListener("click", (event) => {
  const cell = event.target.closest("[data-heat] button");
  if (cell) tell("rs:show", { camera: cell.dataset.camera, frame: Number(cell.dataset.frame) });
});
document.addEventListener("keydown", (event) => { // arrows walk over the map
  const cell = event.target.closest?.("[data-heat] button");
  const step = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [-1, 0], ArrowDown: [1, 0] }[event.key];
  if (!cell || !step) return;
  event.preventDefault();
  const row = cell.closest("tr"), rows = [...row.parentElement.rows];
  const next = rows[rows.indexOf(row) + step[0]]?.cells[cell.parentElement.cellIndex + step[1]]?.querySelector("button");
  if (next) { cell.tabIndex = -1; next.tabIndex = 0; next.focus(); }
});
document.addEventListener("rs:view", (event) => { Object.assign(pressed, event.detail); pressed(); });
document.addEventListener("rs:fresh", pressed);
document.addEventListener("rs:event", (event) => { if (event.detail.kind !== "progress") say(event.detail); });
await tail();
await history();
log.scrollTop = log.scrollHeight;
if (!["succeeded", "failed", "dead", "cancelled"].includes(page.dataset.state)) setInterval(tail, 3000);
