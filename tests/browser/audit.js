// What a screen reader and weak eyes need: names, roles, order of headings, contrast. Returns what is wrong.
const faults = [];
const shown = (node) => node.checkVisibility({ opacityProperty: true, visibilityProperty: true }) && node.getClientRects().length > 0;
const say = (rule, node) => faults.push(`${rule}: ${node.outerHTML.slice(0, 160)}`);

function nameOf(node) {
  if (node.getAttribute("aria-label")) return node.getAttribute("aria-label");
  const by = node.getAttribute("aria-labelledby");
  if (by) return by.split(" ").map((id) => document.getElementById(id)?.textContent ?? "").join(" ");
  if (node.labels?.length) return [...node.labels].map((l) => l.textContent).join(" ");
  if (node.tagName === "IMG") return node.getAttribute("alt");
  return node.textContent || node.title || node.querySelector("img")?.alt || node.querySelector("title")?.textContent || "";
}

for (const node of document.querySelectorAll("a[href], button, input:not([type=hidden]), select, textarea, [role=button], [role=img], progress, [role=region], nav")) {
  if (shown(node) && !nameOf(node).trim()) say("no name", node);
}
for (const image of document.images) if (!image.hasAttribute("alt")) say("no alt", image);
for (const svg of document.querySelectorAll("svg")) if (svg.getAttribute("role") !== "img" && svg.getAttribute("aria-hidden") !== "true" && !svg.closest("[role=img], [aria-hidden=true], .js-plotly-plot, #js-plotly-tester")) say("svg without a role", svg);
for (const label of document.querySelectorAll("label[for]")) if (!document.getElementById(label.htmlFor)) say("label of nothing", label);
const ids = [...document.querySelectorAll("[id]")].filter((n) => !n.closest(".js-plotly-plot")).map((n) => n.id);
for (const id of new Set(ids)) if (ids.filter((other) => other === id).length > 1) faults.push(`id twice: ${id}`);
let level = 0;
for (const head of document.querySelectorAll("h1, h2, h3, h4")) {
  const own = Number(head.tagName[1]);
  if (own > level + 1) say(`heading jumps from ${level}`, head);
  level = own;
}
for (const table of document.querySelectorAll("table")) if (!table.querySelector("th")) say("table without headers", table);
for (const tag of ["main", "header", "footer"]) if (document.querySelectorAll(`body > ${tag}`).length !== 1) faults.push(`${tag}: expected one`);
for (const node of document.querySelectorAll("[tabindex]")) if (node.tabIndex > 0) say("tab order forced", node);

const parse = (text) => (text.match(/[\d.]+/g) ?? [0, 0, 0, 0]).map(Number);
const linear = (c) => (c / 255 <= 0.04045 ? c / 255 / 12.92 : ((c / 255 + 0.055) / 1.055) ** 2.4);
const light = ([r, g, b]) => 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
const over = (top, under) => { const a = top[3] ?? 1; return [0, 1, 2].map((i) => top[i] * a + under[i] * (1 - a)); };

function ground(node) {
  const layers = [];
  for (let at = node; at; at = at.parentElement) {
    const colour = parse(getComputedStyle(at).backgroundColor);
    if (!getComputedStyle(at).backgroundColor.startsWith("rgb")) continue;
    layers.push(colour);
    if ((colour[3] ?? 1) === 1) break;
  }
  return layers.reverse().reduce((under, top) => over(top, under), [255, 255, 255]);
}

const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const node = walker.currentNode.parentElement;
  if (!walker.currentNode.textContent.trim() || !shown(node)) continue;
  if (node.closest("option, script, noscript, .hush, .skip, [aria-hidden=true], :disabled, .option:has(:disabled), .js-plotly-plot, title, .stage")) continue;
  const style = getComputedStyle(node), isSvg = node instanceof SVGElement;
  const under = ground(isSvg ? node.closest("svg").parentElement : node);
  const text = over(parse(isSvg ? style.fill : style.color), under);
  const [a, b] = [light(text), light(under)].sort((x, y) => y - x), ratio = (a + 0.05) / (b + 0.05);
  const size = parseFloat(style.fontSize), large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 600);
  if (ratio < (large ? 3 : 4.5)) say(`contrast ${ratio.toFixed(2)}`, node);
}
if (document.documentElement.scrollWidth > innerWidth + 1) faults.push(`scrolls sideways: ${document.documentElement.scrollWidth} of ${innerWidth}`);
return [...new Set(faults)].slice(0, 12);
