"use strict";

// The page of a tradeoff: a point that is looked at, and a chart of all.

const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const pointOf = new Map(data.points.map((point) => [point.key, point]));
const dense = data.points[0];
const groups = [...new Set(data.points.slice(1).map((point) => point.group))];
const TITLES = { frame_ms: "milliseconds a frame", megabytes: "size of the file, MB", gaussians: "Gaussians", psnr: "PSNR, dB", ssim: "SSIM" };
const state = { cost: "frame_ms", metric: "psnr", reference: dense.photos.psnr === null ? "renders" : "photos", key: data.shown, view: 0 };

function element(parent, name, attributes = {}, text = "") {
  const made = parent.ownerDocument.createElementNS(parent.namespaceURI, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  parent.append(made);
  return made;
}

function steps(low, high, most) {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((factor) => factor * power >= rough);
  const ticks = [];
  for (let i = Math.ceil(low / step); i * step <= high; i++) ticks.push(i * step);
  return ticks;
}

// Ticks of a logarithmic axis: 1, 2 and 5 of each decade; equal distances where it is short.
function logSteps(low, high, most) {
  if (high / low < 8) return steps(low, high, most);
  const ticks = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++) ticks.push(...[1, 2, 5].map((factor) => factor * 10 ** power));
  return ticks.filter((tick) => tick >= low && tick <= high);
}

// A scatter, of which the points of one group are joined, drawn as SVG at the width that there is. `points` have x, y, group (-1 is in no line), key and title.
function drawChart(svg, { points, selected, xTitle, yTitle, onSelect }) {
  const width = svg.parentNode.clientWidth, height = width < 560 ? 300 : 400, most = width < 560 ? 5 : 8;
  const left = 58, right = 18, top = 16, bottom = 46;
  const [xs, ys] = [points.map((point) => point.x), points.map((point) => point.y)];
  const [xLow, xHigh] = [Math.min(...xs) / 1.15, Math.max(...xs) * 1.15];
  const pad = 0.08 * (Math.max(...ys) - Math.min(...ys)) || 1, [yLow, yHigh] = [Math.min(...ys) - pad, Math.max(...ys) + pad];
  const x = (value) => left + ((width - left - right) * Math.log(value / xLow)) / Math.log(xHigh / xLow);
  const y = (value) => height - bottom - ((height - top - bottom) * (value - yLow)) / (yHigh - yLow);
  const text = (value) => `${+value.toPrecision(4)}`;
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const axes = element(svg, "g", { class: "axes" });
  if (!points.length) return;
  for (const tick of logSteps(xLow, xHigh, most)) {
    element(axes, "line", { x1: x(tick), x2: x(tick), y1: top, y2: height - bottom });
    element(axes, "text", { x: x(tick), y: height - bottom + 18, "text-anchor": "middle" }, text(tick));
  }
  for (const tick of steps(yLow, yHigh, most)) {
    element(axes, "line", { x1: left, x2: width - right, y1: y(tick), y2: y(tick) });
    element(axes, "text", { x: left - 8, y: y(tick) + 4, "text-anchor": "end" }, text(tick));
  }
  element(axes, "text", { x: (left + width - right) / 2, y: height - 8, "text-anchor": "middle" }, xTitle);
  element(axes, "text", { x: -(top + height - bottom) / 2, y: 13, "text-anchor": "middle", transform: "rotate(-90)" }, yTitle);
  for (const group of new Set(points.map((point) => point.group))) {
    const members = points.filter((point) => point.group === group).sort((a, b) => a.x - b.x);
    const mark = element(svg, "g", { class: `group${(group + 1) % 6}` });
    element(mark, "path", { d: `M${members.map((point) => `${x(point.x)} ${y(point.y)}`).join("L")}` });
    for (const point of members) {
      const spot = element(mark, "circle", { cx: x(point.x), cy: y(point.y), r: point.key === selected ? 9 : 6, "data-key": point.key });
      element(spot, "title", {}, point.title);
      spot.addEventListener("click", () => onSelect(point.key));
    }
  }
}

function showChart() {
  const quality = (point) => point[state.reference][state.metric];
  drawChart(byId("chart").querySelector("svg"), {
    points: data.points.filter((point) => quality(point) !== null).map((point) => ({
      key: point.key, title: `${point.label}: ${point.figures}`, x: point[state.cost], y: quality(point), group: groups.indexOf(point.group),
    })),
    selected: state.key, xTitle: TITLES[state.cost], yTitle: TITLES[state.metric], onSelect: select,
  });
}

function showPoint() {
  const point = pointOf.get(state.key), pictures = data.pictures[state.view];
  const [other, name] = state.reference === "photos" ? ["photo", "photo, held out"] : [dense.key, dense.label];
  byId("shown-name").textContent = point.label;
  byId("shown-figures").textContent = point.figures;
  byId("shown-command").hidden = !point.command;
  byId("shown-command").firstElementChild.textContent = point.command;
  for (const [place, side, key, label] of [["over", "left", point.key, point.label], ["under", "right", other, name]]) {
    byId(`wipe-${place}`).src = pictures[key];
    byId(`wipe-${place}`).alt = `${label}, view ${state.view + 1}`;
    byId(`wipe-${side}`).textContent = label;
  }
  for (const row of byId("points").tBodies[0].rows) row.classList.toggle("selected", row.dataset.key === state.key);
}

function show() {
  showChart();
  showPoint();
}

function select(key) {
  state.key = key;
  show();
}

data.pictures.forEach((pictures, index) => {
  const label = element(byId("views"), "label");
  const input = element(label, "input", { type: "radio", name: "view", "aria-label": `View ${index + 1}` });
  input.checked = index === state.view;
  element(label, "img", { src: pictures[dense.key], alt: "" });
  input.addEventListener("change", () => {
    state.view = index;
    showPoint();
  });
});
for (const input of document.querySelectorAll(".choice input"))
  input.addEventListener("change", () => {
    state[input.name] = input.value;
    show();
  });
for (const row of byId("points").tBodies[0].rows)
  row.querySelector("button").addEventListener("click", () => {
    select(row.dataset.key);
    byId("look").scrollIntoView();
  });
groups.forEach((group, index) => {
  element(element(byId("legend"), "li", { class: `group${(index + 1) % 6}` }), "span", {}, group);
});
byId("wipe-range").addEventListener("input", (event) => byId("wipe").style.setProperty("--at", `${event.target.value}%`));
new ResizeObserver(showChart).observe(byId("chart").parentNode);
show();
