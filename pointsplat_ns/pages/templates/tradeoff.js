const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const pointOf = new Map(data.points.map((point) => [point.key, point]));
const dense = data.points[0];
const groups = [...new Set(data.points.slice(1).map((point) => point.group))];
const TITLES = { frame_ms: "milliseconds a frame", megabytes: "size of the file, MB", gaussians: "Gaussians", psnr: "PSNR, dB", ssim: "SSIM" };
const state = { cost: "frame_ms", metric: "psnr", reference: dense.photos.psnr === null ? "renders" : "photos", key: data.shown, view: 0 };

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

function start() {
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
}

start();
