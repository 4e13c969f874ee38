// The little that our own drawings need of a plotting library.
export const ns = "http://www.w3.org/2000/svg";

export function node(name, attributes = {}, text = null) {
  const made = document.createElementNS(ns, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== null) made.textContent = text;
  return made;
}

export function ticks(low, high, most = 5) {
  const span = Math.max(high - low, 1e-9 * Math.abs(high)) || 1; // a span of rounding errors has no ticks to count
  const rough = span / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((f) => f * power).find((s) => s >= rough);
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) found.push(Number((i * step).toPrecision(12)));
  return found;
}

export const line = (points) => points.map(([x, y], i) => `${i ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("");
export const kilo = (value) => (Math.abs(value) >= 10000 ? `${+(value / 1000).toPrecision(3)}k` : `${+value.toPrecision(4)}`);
export const slug = (method) => `m-${method.replaceAll("+", "-")}`;
