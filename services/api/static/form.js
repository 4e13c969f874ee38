// The submit form: what the choices mean for one another, how long the job will take, and the request itself.
import { api, duration, reasonOf, send } from "./live.js";

const form = document.getElementById("new-job");
const presets = JSON.parse(form.querySelector("[data-presets]").textContent);
const key = crypto.randomUUID(); // pressing twice, or again after a lost reply, submits once
let asking = 0;

const numeric = (input) => input.type === "number";

function valueOf(input) {
  if (numeric(input)) return Number(input.value);
  if (input.value === "true" || input.value === "false") return input.value === "true";
  return /^\d+$/.test(input.value) ? Number(input.value) : input.value;
}

function spec() {
  const found = {}, ablation = {};
  for (const input of form.elements) {
    if (!input.name || input.disabled || input.value === "") continue;
    if ((input.type === "radio" || input.type === "checkbox") && !input.checked) continue;
    if (input.name.startsWith("ablation.")) ablation[input.name.slice(9)] = true;
    else found[input.name] = ["method", "subject", "preset"].includes(input.name) ? input.value : valueOf(input);
  }
  if (Object.keys(ablation).length) found.ablation = ablation;
  return found;
}

function fitFlags() {
  const chosen = form.querySelector("[name=method]:checked");
  const has = new Set((chosen?.dataset.flags ?? "").split(" "));
  for (const input of form.querySelectorAll("[name^='ablation.']")) {
    input.disabled = !has.has(input.name.slice(9));
    if (input.disabled) input.checked = false;
  }
  form.querySelector("[data-no-flags]").hidden = [...form.querySelectorAll("[name^='ablation.']")].some((i) => !i.disabled);
}

function fitPlaceholders() {
  const preset = presets.find((p) => p.preset === form.querySelector("[name=preset]:checked")?.value) ?? {};
  for (const input of form.querySelectorAll(".choice input")) {
    input.dataset.usual ??= input.placeholder;
    input.placeholder = preset[input.name] ?? input.dataset.usual;
  }
}

function clear() {
  for (const fault of form.querySelectorAll(".fault[role]")) { fault.hidden = true; fault.textContent = ""; }
  for (const input of form.querySelectorAll("[aria-invalid]")) input.removeAttribute("aria-invalid");
}

function blame(problem) {
  let first = null;
  for (const error of problem.errors ?? []) {
    const name = error.name.split(".")[0];
    const box = form.querySelector(`[data-field-box="${CSS.escape(name)}"]`);
    if (!box) continue;
    const fault = box.querySelector(".fault"), input = box.querySelector("input, select");
    fault.textContent = `expected ${error.expected}, got ${error.got}`;
    fault.hidden = false;
    input.setAttribute("aria-invalid", "true");
    box.closest("details").open = true;
    first ??= input;
  }
  const place = form.querySelector("[data-fault]");
  place.textContent = problem.detail;
  place.hidden = Boolean(first);
  first?.focus();
}

function blameLocally() { // what the browser can tell by itself
  const wrong = [...form.querySelectorAll(".choice input")].filter((input) => !input.checkValidity());
  if (!wrong.length) return false;
  const errors = wrong.map((i) => ({ name: i.name, expected: i.validationMessage.replace(/\.$/, ""), got: i.value }));
  blame({ errors, detail: "" });
  return true;
}

async function estimate() {
  const place = form.querySelector("[data-estimate]"), basis = form.querySelector("[data-basis]");
  if (!form.checkValidity()) { place.textContent = "not a job yet"; basis.textContent = "A value is out of its range."; return; }
  const reply = await send(`${api}/grids?dry_run=true`, {
    headers: { "content-type": "application/json" }, body: JSON.stringify({ name: "estimate", base: spec() }),
  });
  if (!reply.ok) { place.textContent = "not a job yet"; basis.textContent = await reasonOf(reply); return; }
  clear();
  const plan = await reply.json(), found = plan.estimates[0];
  const wait = plan.eta_seconds > found.seconds * 1.5 ? `, ${duration(plan.eta_seconds)} with the queue` : "";
  place.textContent = plan.reused ? "finished already: answered at once" : `about ${duration(found.seconds)}${wait}`;
  basis.textContent = found.basis;
}

function changed() {
  fitFlags();
  fitPlaceholders();
  clearTimeout(asking);
  asking = setTimeout(estimate, 250);
}

form.addEventListener("input", changed);
form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const button = form.querySelector("[type=submit]");
  clear();
  if (blameLocally()) return;
  button.disabled = true;
  const body = JSON.stringify(spec());
  const headers = { "content-type": "application/json", "idempotency-key": `${key}-${hash(body)}` };
  const reply = await send(`${api}/jobs`, { headers, body });
  button.disabled = false;
  if (reply.ok) location.assign(`/jobs/${(await reply.json()).id}`);
  else blame(await reply.json());
});

function hash(text) { // another spec is another request
  let value = 0;
  for (const letter of text) value = (value * 31 + letter.codePointAt(0)) >>> 0;
  return value.toString(16);
}

changed();
