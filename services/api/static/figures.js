// A figure that cannot be drawn says why, where the browser would show a broken picture.
for (const image of document.querySelectorAll(".plate img")) {
  const link = image.closest("a"), words = link.querySelector(".pending");
  const explain = async () => {
    link.classList.add("failed");
    const reply = await fetch(image.src);
    const detail = reply.ok ? "it was drawn just now; load the page again" : (await reply.json()).detail;
    words.textContent = `This figure could not be drawn: ${detail}`;
    words.setAttribute("role", "status");
  };
  image.addEventListener("error", explain);
  if (image.complete && image.naturalWidth === 0 && image.currentSrc) explain();
}
