// Plotly in our own colours and type.
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const colour = (method) => css(`--method-${method.replaceAll("+", "-")}`) || css("--accent");
export const series = () => ["rs-avatar", "gauhuman", "mad-avatar", "cvr+gauhuman", "jamnet+gauhuman", "flow+gauhuman", "oracle"].map(colour);

function axis(given) {
  const title = { standoff: 10, ...given.title, font: { size: 13 } };
  return { gridcolor: css("--rule"), zeroline: false, linecolor: css("--ink-3"), ticks: "outside", tickcolor: css("--ink-3"), ticklen: 4, automargin: true, ...given, title };
}

export function layout({ x, y, ...more }) {
  return {
    font: { family: css("--text"), size: 13, color: css("--ink-2") }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    margin: { l: 60, r: 16, t: 12, b: 40 }, hovermode: "closest", legend: { orientation: "h", x: 0, y: 0, yref: "container", yanchor: "bottom" }, colorway: series(),
    hoverlabel: { bgcolor: css("--surface"), bordercolor: css("--rule"), font: { color: css("--ink"), family: css("--text") } },
    modebar: { bgcolor: "rgba(0,0,0,0)", color: css("--ink-3"), activecolor: css("--accent") },
    xaxis: axis(x), yaxis: axis(y), ...more,
  };
}

export function draw(place, traces, how) {
  if (!window.Plotly) { place.textContent = "The chart library could not be loaded."; return; }
  for (const name of ["x", "y"]) { // digits of a decade would lie upon one another: 1, 2 and 5 are enough
    const values = traces.flatMap((trace) => [...trace[name]]).filter((value) => value > 0);
    if (how[name].type === "log" && Math.max(...values) > 8 * Math.min(...values)) how[name].dtick = "D2";
  }
  window.Plotly.react(place, traces, layout(how), { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d"], toImageButtonOptions: { format: "svg" } });
}

export const redraw = (again) => matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
