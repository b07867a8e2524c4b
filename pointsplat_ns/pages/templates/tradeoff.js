const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const pointOf = new Map(data.points.map((point) => [point.key, point]));
const dense = data.points[0];
const groups = [...new Set(data.points.map((point) => point.group))];
const hasPhotos = dense.photos.psnr !== null;

const NAMES = {
  frame_ms: "milliseconds a frame", bytes: "size of the file, MB", gaussians: "Gaussians",
  psnr: "PSNR, dB", ssim: "SSIM", lpips: "LPIPS (less is better)",
  renders: "the dense scene's render", photos: "the photo",
};
const DIGITS = { psnr: 2, ssim: 3, lpips: 3 };

// Targets are against renders. A search has no questions: its answer is the recommended point.
const state = {
  cost: data.found ? "bytes" : "frame_ms", metric: "psnr", reference: hasPhotos && !data.found ? "photos" : "renders", key: null, view: 0,
  photos: Number(byId("within")?.value), renders: Number(byId("above")?.value),
};

const qualityOf = (point, metric = state.metric) => {
  const value = point[state.reference][metric];
  return value === null ? null : Number(value);
};
const short = (value) => (value >= 1e6 ? `${+(value / 1e6).toPrecision(3)} M` : value >= 1e3 ? `${+(value / 1e3).toPrecision(3)} k` : `${+value.toPrecision(3)}`);
const times = (ratio) => `${ratio < 10 ? ratio.toFixed(1) : ratio.toFixed(0)}×`;
const percent = (share) => `${+(100 * share).toPrecision(3)} %`;
const megabytes = (bytes) => `${+(bytes / 1e6).toPrecision(3)} MB`;
const milliseconds = (time) => `${(+time.toPrecision(3)).toLocaleString("en")} ms`;
const withUnit = (value, metric) =>
  value === null ? "not measured" : value === Infinity ? "identical" : value.toFixed(DIGITS[metric]) + (metric === "psnr" ? " dB" : "");

// The fastest point that is good enough, and the PSNR that this takes. 1e-9: decimal numbers are not exact in binary.
function recommended() {
  if (data.found) return { point: pointOf.get(data.found), least: null };
  const least = state.reference === "photos" ? Number(dense.photos.psnr) - state.photos : state.renders;
  const key = data.fastest.find((name) => {
    const value = pointOf.get(name)[state.reference].psnr;
    return value !== null && Number(value) >= least - 1e-9;
  });
  return { point: pointOf.get(key), least };
}

// The points that no other beats in both cost and quality, cheapest first. Of equal ones, the first.
function front() {
  const sign = state.metric === "lpips" ? -1 : 1; // a distance: less is better
  const quality = (point) => sign * qualityOf(point);
  const shown = data.points.filter((point) => qualityOf(point) !== null);
  shown.sort((a, b) => a[state.cost] - b[state.cost] || (quality(a) === quality(b) ? 0 : quality(b) - quality(a)));
  let best = -Infinity;
  return shown.filter((point) => quality(point) > best && ((best = quality(point)), true)).map((point) => point.key);
}

function fillFacts(list, facts) {
  list.replaceChildren();
  for (const [name, value] of facts) {
    const box = element(list, "div");
    element(box, "dt", {}, name);
    element(box, "dd", {}, value);
  }
}

function fillCommand(box, command) {
  box.hidden = !command;
  box.querySelector("code").textContent = command;
}

function factsOf(point) {
  const value = qualityOf(point, "psnr"), full = qualityOf(dense, "psnr");
  const facts = [
    ["as fast", times(dense.frame_ms / point.frame_ms)],
    ["of the Gaussians", percent(point.gaussians / dense.gaussians)],
    ["file", megabytes(point.bytes)],
  ];
  if (state.reference === "photos" && value !== null && full !== null && point !== dense)
    facts.push(["PSNR against photos", `${value < full ? "−" : "+"}${Math.abs(full - value).toFixed(2)} dB`]);
  else facts.push([`PSNR against ${state.reference === "photos" ? "photos" : "renders"}`, withUnit(value, "psnr")]);
  return facts;
}

// The recommended point; in place of the dense scene the one that comes next, so that there is something to compare.
function answer() {
  const { point } = recommended();
  if (point !== dense || data.points.length === 1) return { point, name: point.label };
  const psnr = (other) => Number(other[state.reference].psnr ?? -Infinity);
  const next = data.points.filter((other) => other !== dense).reduce((best, other) => (psnr(other) > psnr(best) ? other : best));
  return { point: next, name: `${dense.label}: nothing faster is good enough. The next best: ${next.label}` };
}

function showRecommended() {
  for (const question of document.querySelectorAll(".question")) question.hidden = question.dataset.reference !== state.reference;
  const { point, name } = answer();
  byId("recommended-name").textContent = name;
  byId("recommended-show").dataset.key = point.key;
  fillFacts(byId("recommended-facts"), factsOf(point));
  fillCommand(byId("recommended-command"), point.command);
}

function showChart() {
  const shown = data.points.filter((point) => qualityOf(point) !== null);
  const factor = state.cost === "bytes" ? 1e-6 : 1;
  const keys = front();
  const { point: best, least } = recommended();
  const tip = byId("chart").querySelector(".tip");
  const figuresOf = (point) =>
    `${withUnit(qualityOf(point), state.metric)}, ${milliseconds(point.frame_ms)}, ` +
    `${point.gaussians.toLocaleString("en")} Gaussians, ${megabytes(point.bytes)}`;
  drawChart(byId("chart").querySelector("svg"), {
    points: shown.map((point) => ({
      key: point.key, title: `${point.label}: ${figuresOf(point)}`, x: point[state.cost] * factor, y: qualityOf(point), group: groups.indexOf(point.group),
      low: state.cost === "frame_ms" ? point.frame_ms_low : null, high: state.cost === "frame_ms" ? point.frame_ms_high : null,
    })),
    front: keys.map((key) => shown.findIndex((point) => point.key === key)),
    selected: shown.findIndex((point) => point.key === state.key),
    marked: shown.indexOf(best),
    threshold: state.metric === "psnr" ? least : null,
    xTitle: NAMES[state.cost], yTitle: NAMES[state.metric],
    xText: short, yText: (value) => `${+value.toPrecision(4)}`,
    lessIsBetter: state.metric === "lpips",
    onSelect: (index) => select(shown[index].key),
    onPoint: (index, x, y) => {
      tip.hidden = index === null;
      if (index === null) return;
      tip.replaceChildren();
      element(tip, "strong", {}, shown[index].label);
      element(tip, "span", {}, figuresOf(shown[index]));
      tip.style.left = `${Math.min(Math.max(x, 110), byId("chart").clientWidth - 110)}px`;
      tip.style.top = `${y}px`;
      tip.classList.toggle("below", y < 110);
    },
  });
  for (const row of byId("points").tBodies[0].rows) {
    row.classList.toggle("on-front", keys.includes(row.dataset.key));
    row.classList.toggle("selected", row.dataset.key === state.key);
  }
}

function showLegend() {
  const list = byId("legend");
  list.replaceChildren();
  groups.forEach((group, index) => {
    const item = element(list, "li");
    const svg = element(byId("chart").querySelector("svg"), "svg", { viewBox: "-9 -9 18 18", width: 18, height: 18, "aria-hidden": "true" });
    element(svg, "path", { d: SHAPES[index % SHAPES.length](5.5), class: `shape group${index % 6}` });
    item.append(svg, group);
  });
  element(list, "li", { class: "ring-legend" }, data.found ? "the answer above" : "recommended above");
}

// The stops of the slider: the front, and the point that is shown where it lies off the front.
function stops() {
  return [...new Set([...front(), state.key])].sort((a, b) => pointOf.get(a)[state.cost] - pointOf.get(b)[state.cost]);
}

function showPoint() {
  const point = pointOf.get(state.key), pictures = data.pictures[state.view], keys = stops(), slider = byId("stop");
  const onFront = front().includes(state.key);
  const name = point.label + (onFront ? "" : " (not on the front)");
  slider.max = keys.length - 1;
  slider.value = keys.indexOf(state.key);
  slider.setAttribute("aria-valuetext", name);
  byId("stop-name").textContent = name;
  fillFacts(byId("shown-facts"), [...factsOf(point), ["a frame", milliseconds(point.frame_ms)]]);
  fillCommand(byId("shown-command"), point.command);
  const reference = state.reference === "photos" && pictures.photo ? "photos" : "renders";
  const what = `view ${state.view + 1}`;
  const set = (id, uri, alt) => {
    byId(id).src = uri;
    byId(id).alt = alt;
  };
  set("wipe-over", pictures[point.key], `${point.label}, ${what}`);
  set("wipe-under", reference === "photos" ? pictures.photo : pictures[dense.key], `${reference === "photos" ? "Photo" : dense.label}, ${what}`);
  byId("wipe-left").textContent = point.label;
  byId("wipe-right").textContent = reference === "photos" ? "Photo" : dense.label;
  set("panel-point", pictures[point.key], `${point.label}, ${what}`);
  byId("panel-point-name").textContent = point.label;
  set("panel-dense", pictures[dense.key], `${dense.label}, ${what}`);
  byId("panel-photo-figure").hidden = !pictures.photo;
  if (pictures.photo) set("panel-photo", pictures.photo, `Photo, ${what}`);
  const map = pictures[`${reference}:${point.key}`];
  byId("error").hidden = !map;
  byId("no-error").hidden = Boolean(map);
  byId("no-error").textContent = "No error: this is the dense scene itself.";
  if (map) set("error", map, `Error map of ${point.label} against ${NAMES[reference]}, ${what}`);
  byId("error-name").textContent = NAMES[reference];
}

function showAll() {
  showRecommended();
  showChart();
  showPoint();
}

function select(key) {
  state.key = key;
  showChart();
  showPoint();
}

function makeViews() {
  data.pictures.forEach((pictures, index) => {
    const label = element(byId("views"), "label");
    const input = element(label, "input", { type: "radio", name: "view", value: index, "aria-label": `View ${index + 1}` });
    input.checked = index === state.view;
    element(label, "img", { src: pictures[dense.key], alt: "" });
    input.addEventListener("change", () => {
      state.view = index;
      showPoint();
    });
  });
}

function makeChoices() {
  for (const input of document.querySelectorAll(".choice input")) {
    input.checked = state[input.name] === input.value;
    input.addEventListener("change", () => {
      state[input.name] = input.value;
      if (qualityOf(pointOf.get(state.key)) === null) state.key = dense.key;
      showAll();
    });
  }
  for (const [id, reference] of [["within", "photos"], ["above", "renders"]]) {
    const inputs = [byId(id), byId(`${id}-range`)].filter(Boolean);
    for (const input of inputs)
      input.addEventListener("input", () => {
        const value = input.valueAsNumber;
        if (!Number.isFinite(value) || value < 0) return;
        state[reference] = value;
        for (const other of inputs) if (other !== input) other.value = value;
        showRecommended();
        showChart();
      });
  }
}

async function copy(box) {
  const code = box.querySelector("code"), button = box.querySelector("button");
  let done = true;
  try {
    await navigator.clipboard.writeText(code.textContent);
  } catch {
    getSelection().selectAllChildren(code);
    done = document.execCommand("copy"); // the only way where a browser gives local files no clipboard
  }
  button.textContent = done ? "Copied" : "Press Ctrl+C";
  setTimeout(() => (button.textContent = "Copy"), 2000);
}

function makeTable() {
  const table = byId("points"), body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
  const numberOf = (row, column) => {
    const value = row.cells[column].dataset.value;
    return value === "" ? NaN : value === "inf" ? Infinity : Number(value);
  };
  heads.forEach((head, column) =>
    head.firstElementChild.addEventListener("click", () => {
      const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
      for (const other of heads) other.setAttribute("aria-sort", "none");
      head.setAttribute("aria-sort", sign === 1 ? "ascending" : "descending");
      const rows = [...body.rows].sort((a, b) => {
        const [first, second] = [numberOf(a, column), numberOf(b, column)];
        if (Number.isNaN(first) || Number.isNaN(second)) return Number.isNaN(first) - Number.isNaN(second);
        return first === second ? 0 : first < second ? -sign : sign;
      });
      body.append(...rows);
    }),
  );
  for (const row of body.rows)
    row.cells[0].firstElementChild.addEventListener("click", () => {
      select(row.dataset.key);
      byId("look").scrollIntoView({ block: "start" });
    });
}

function start() {
  state.key = answer().point.key;
  makeViews();
  makeChoices();
  makeTable();
  for (const box of document.querySelectorAll(".command")) box.querySelector("button").addEventListener("click", () => copy(box));
  byId("stop").addEventListener("input", (event) => select(stops()[Number(event.target.value)]));
  byId("recommended-show").addEventListener("click", (event) => {
    select(event.target.dataset.key);
    byId("look").scrollIntoView({ block: "start" });
  });
  byId("wipe-range").addEventListener("input", (event) => byId("wipe").style.setProperty("--at", `${event.target.value}%`));
  showLegend();
  showAll();
  let width = byId("chart").clientWidth;
  new ResizeObserver(() => {
    if (byId("chart").clientWidth === width) return;
    width = byId("chart").clientWidth;
    showChart();
  }).observe(byId("chart"));
}

start();
const flight = data.flight && new Flight(byId("flight"), data.flight);
