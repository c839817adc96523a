"use strict";

const variable = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();

/* A figure in the colours of the page; `meta` of a trace names its own. */
function coloured({ data, layout }) {
  const axis = { gridcolor: variable("line"), linecolor: variable("line"), zerolinecolor: variable("line") };
  const clear = "rgba(0,0,0,0)";
  const themed = { ...layout, font: { color: variable("text"), size: 13 }, paper_bgcolor: clear, plot_bgcolor: clear };
  themed.hoverlabel = { ...layout.hoverlabel, bgcolor: variable("raised"), font: { color: variable("text") } };
  for (const name of Object.keys(layout).filter((key) => /^[xy]axis/.test(key)))
    themed[name] = { ...layout[name], ...axis, automargin: true };
  if (layout.scene) {
    themed.scene = { ...layout.scene };
    for (const name of ["xaxis", "yaxis", "zaxis"])
      themed.scene[name] = { ...layout.scene[name], ...axis, backgroundcolor: clear, color: variable("faint") };
  }
  const traces = data.map((trace) => {
    const color = variable(trace.meta);
    return { ...trace, marker: { ...trace.marker, color }, line: { ...trace.line, color } };
  });
  return [traces, themed];
}

const figures = [...document.querySelectorAll(".figure")].map((element) => {
  const figure = JSON.parse(element.querySelector("script").textContent);
  element.textContent = "";
  return [element, figure];
});
const draw = () =>
  figures.forEach(([element, figure]) =>
    Plotly.react(element, ...coloured(figure), { responsive: true, displaylogo: false }));
draw();
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);

const table = document.getElementById("views");
const body = table.tBodies[0];
const headings = [...table.tHead.rows[0].cells];

/* Numbers by value, words by letter; cells without a value come last either way. */
function sortBy(heading) {
  const descending = heading.ariaSort === "ascending";
  headings.forEach((other) => other.removeAttribute("aria-sort"));
  heading.ariaSort = descending ? "descending" : "ascending";
  const text = (row) => row.cells[heading.cellIndex].textContent;
  const rows = [...body.rows];
  const numeric = rows.every((row) => text(row) === "–" || !isNaN(text(row)));
  const order = (a, b) => (numeric ? a - b : a.localeCompare(b, undefined, { numeric: true }));
  const empty = (value) => value === "" || value === "–";
  rows.sort((a, b) => {
    const [x, y] = [text(a), text(b)];
    return empty(x) || empty(y) ? empty(x) - empty(y) : (descending ? -1 : 1) * order(x, y);
  });
  body.append(...rows);
}

const find = document.getElementById("find");
const chosen = document.getElementById("status");
function filter() {
  const sought = find.value.toLowerCase();
  let shown = 0;
  for (const row of body.rows) {
    row.hidden =
      (chosen.value && row.dataset.status !== chosen.value) || !row.textContent.toLowerCase().includes(sought);
    shown += !row.hidden;
  }
  document.getElementById("shown").textContent = `${shown} of ${body.rows.length} views`;
}

headings.forEach((heading) => heading.firstElementChild.addEventListener("click", () => sortBy(heading)));
find.addEventListener("input", filter);
chosen.addEventListener("change", filter);
find.form.addEventListener("submit", (event) => event.preventDefault());
