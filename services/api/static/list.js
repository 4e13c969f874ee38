// Choosing jobs to compare.
const button = document.querySelector("[data-compare]");
const most = 6;

function count() {
  const chosen = document.querySelectorAll("#compare input:checked").length;
  button.disabled = chosen < 2 || chosen > most;
  button.querySelector("[data-chosen]").textContent = chosen ? `${chosen}${chosen > most ? ` of at most ${most}` : ""}` : "";
}

document.addEventListener("change", (event) => {
  if (event.target.matches("#compare input")) count();
  if (event.target.matches(".filters select")) event.target.form.requestSubmit(event.target.form.querySelector("button:not([data-compare])"));
});
document.addEventListener("rs:fresh", count);
if (button) count();
