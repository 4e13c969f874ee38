// Sends an archive as it is, with its progress, and shows what the check says of it.
import { api, refresh } from "./live.js";

const form = document.getElementById("upload");
const bar = document.querySelector("[data-upload]"), fault = document.querySelector("[data-fault]");
const types = { zip: "application/zip", gz: "application/gzip", tgz: "application/gzip" };

function say(text) { fault.textContent = text; fault.hidden = !text; }

form.addEventListener("submit", (event) => {
  event.preventDefault();
  const name = form.elements.name.value, file = form.elements.archive.files[0];
  if (!/^[A-Za-z0-9][A-Za-z0-9._-]*$/.test(name)) { say("name: expected letters, digits, dots, dashes or underscores, beginning with a letter or digit"); form.elements.name.focus(); return; }
  const type = types[file?.name.split(".").at(-1).toLowerCase()];
  if (!type) { say(`archive: expected a .zip or .tar.gz file, got ${file ? file.name : "none"}`); form.elements.archive.focus(); return; }
  say("");
  const request = new XMLHttpRequest(); // fetch tells nothing of what has been sent
  request.open("POST", `${api}/subjects?name=${encodeURIComponent(name)}`);
  request.setRequestHeader("content-type", type);
  const csrf = document.querySelector("meta[name=csrf]")?.content;
  if (csrf) request.setRequestHeader("X-CSRF-Token", csrf);
  request.upload.onprogress = (e) => { bar.hidden = false; bar.value = e.loaded / e.total; };
  request.onload = () => {
    bar.hidden = true;
    if (request.status < 300) { refresh().then(() => location.reload()); return; }
    try { say(JSON.parse(request.responseText).detail); } catch { say(`${request.status}: the service refused the archive`); }
  };
  request.onerror = () => { bar.hidden = true; say("The connection broke before the archive arrived. Try again."); };
  request.send(file);
});
