"use strict";
// Rows are made when they come into view, so that the page opens as fast with 10,000 captures as with ten.
const {columns, common, rows} = JSON.parse(document.getElementById("data").textContent);
const at = Object.fromEntries(columns.map((name, index) => [name, index]));
const value = (row, name) => name in common ? common[name][row[at[name]]] : row[at[name]];
const number = (digits, factor = 1) => x => x === null ? "–" : (factor * x).toFixed(digits);
const shown = [
  {title: "", name: "thumbnail"},
  {title: "capture", name: "capture"},
  {title: "status", name: "status"},
  {title: "reason", name: "reason"},
  {title: "solved", name: "solved", text: (x, row) => `${x} / ${value(row, "views")}`},
  {title: "RMSE, px", name: "rmse_px", text: number(2)},
  {title: "σ, °", name: "sigma_rot_deg", text: number(2)},
  {title: "σ, cm", name: "sigma_trans_m", text: number(1, 100)},
  {title: "focal, px", name: "focal_px", text: number(0)},
  {title: "time, s", name: "seconds", text: number(2)},
  {title: "tries", name: "attempts", text: String},
  {title: "node", name: "node"},
];
const STEP = 60;
const body = document.querySelector("#captures tbody");
const more = document.getElementById("more");
const search = document.getElementById("search");
const status = document.getElementById("status");
let chosen = rows, drawn = 0, sorted = {name: "", up: true};

const path = (row, file) => `${encodeURIComponent(value(row, "capture"))}/${file}`;

function cell(row, column) {
  const td = document.createElement("td"), content = value(row, column.name);
  switch (column.name) {
    case "thumbnail":
      if (content) {
        const image = document.createElement("img");
        image.loading = "lazy"; image.alt = ""; image.src = path(row, content);
        td.append(image);
      }
      break;
    case "capture":
      td.className = "name";
      if (value(row, "has_report")) {
        const link = document.createElement("a");
        link.href = path(row, "report.html"); link.textContent = content;
        td.append(link);
      } else td.textContent = content;
      break;
    case "status": {
      const kind = document.createElement("span");
      kind.className = `kind ${content}`; kind.textContent = content;
      td.append(kind);
      break;
    }
    default:
      td.className = column.text ? "number" : column.name === "reason" ? "why" : "";
      td.textContent = column.text ? column.text(content, row) : content;
  }
  return td;
}

function draw() {
  const piece = document.createDocumentFragment();
  for (const row of chosen.slice(drawn, drawn + STEP)) {
    const tr = document.createElement("tr");
    tr.append(...shown.map(column => cell(row, column)));
    piece.append(tr);
  }
  body.append(piece);
  drawn = Math.min(drawn + STEP, chosen.length);
}

function begin() {
  const text = search.value.trim().toLowerCase();
  chosen = rows.filter(row => (!status.value || value(row, "status") === status.value)
    && (!text || value(row, "capture").toLowerCase().includes(text) || value(row, "reason").toLowerCase().includes(text)));
  if (sorted.name) {
    const sign = sorted.up ? 1 : -1;
    chosen.sort((a, b) => {
      const x = value(a, sorted.name), y = value(b, sorted.name);
      if (x === null || y === null) return (x === null) - (y === null);
      return sign * (typeof x === "number" ? x - y : x < y ? -1 : +(x > y));
    });
  }
  document.getElementById("shown").textContent = `${chosen.length.toLocaleString("en")} captures`;
  body.replaceChildren(); drawn = 0;
  draw();
}

const head = document.createElement("tr");
for (const column of shown) {
  const th = document.createElement("th");
  th.textContent = column.title; th.className = column.text ? "number" : "";
  th.addEventListener("click", () => {
    sorted = {name: column.name, up: sorted.name === column.name ? !sorted.up : true};
    begin();
  });
  head.append(th);
}
document.querySelector("#captures thead").append(head);
for (const name of common.status) status.append(new Option(name, name));
search.addEventListener("input", begin);
status.addEventListener("change", begin);
new IntersectionObserver(seen => { if (seen.some(one => one.isIntersecting) && drawn < chosen.length) draw(); },
  {rootMargin: "600px"}).observe(more);
addEventListener("scroll", () => { if (more.getBoundingClientRect().top < innerHeight + 600 && drawn < chosen.length) draw(); });
begin();
