"use strict";

// A scatter of points with their Pareto front, drawn as SVG at the width that there is. Points are the options of a
// listbox: one of them is in the order of tabs, and arrow keys go to its neighbours.

const SHAPES = [
  (r) => `M${-r} 0a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0z`,
  (r) => `M${-r * 0.9} ${-r * 0.9}h${r * 1.8}v${r * 1.8}h${-r * 1.8}z`,
  (r) => `M0 ${-r * 1.2}L${r * 1.15} ${r * 0.85}H${-r * 1.15}z`,
  (r) => `M0 ${-r * 1.3}L${r * 1.3} 0L0 ${r * 1.3}L${-r * 1.3} 0z`,
  (r) => `M0 ${r * 1.2}L${r * 1.15} ${-r * 0.85}H${-r * 1.15}z`,
];

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
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high * (1 + 1e-9); i++) ticks.push(Number((i * step).toPrecision(12)));
  return ticks;
}

// Ticks of a logarithmic axis: round factors in each decade, as many as fit; equal distances where it is short.
function logSteps(low, high, most) {
  if (high / low < 4) return steps(low, high, most);
  for (const factors of [[1, 1.5, 2, 3, 4, 5, 7], [1, 2, 3, 5], [1, 2, 5], [1, 3], [1]]) {
    const ticks = [];
    for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power++)
      ticks.push(...factors.map((factor) => factor * 10 ** power).filter((tick) => tick >= low && tick <= high));
    if (ticks.length <= most) return ticks;
  }
  return [];
}

// `points` have x, y (which may be infinite), low, high (null: no spread), label, title, group; `front` is a list of
// indices.
function drawChart(svg, { points, front, selected, marked, threshold, xTitle, yTitle, xText, yText, lessIsBetter, onSelect, onPoint }) {
  const width = svg.parentNode.clientWidth, small = width < 560, height = small ? 300 : 400;
  const left = 58, right = 18, bottom = 46;
  const someInfinite = points.some((point) => point.y === Infinity);
  const top = someInfinite ? 52 : 22;
  const finite = points.map((point) => point.y).filter(Number.isFinite);
  if (Number.isFinite(threshold)) finite.push(threshold);
  let low = Math.min(...finite), high = Math.max(...finite);
  if (!finite.length) [low, high] = [0, 1];
  const pad = (high - low) * 0.08 || Math.abs(high) * 0.05 || 1;
  [low, high] = [low - pad, high + pad];
  const xs = points.flatMap((point) => [point.x, point.low ?? point.x, point.high ?? point.x]);
  const xLow = Math.min(...xs) / 1.15, xHigh = Math.max(...xs) * 1.15;
  const x = (value) => left + ((width - left - right) * Math.log(value / xLow)) / Math.log(xHigh / xLow);
  const y = (value) => {
    if (value === Infinity) return 22;
    const share = (value - low) / (high - low);
    return top + (height - top - bottom) * (lessIsBetter ? share : 1 - share);
  };
  svg.replaceChildren();
  svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
  svg.setAttribute("height", height);
  const axes = element(svg, "g", { class: "axes", "aria-hidden": "true" });
  for (const tick of logSteps(xLow, xHigh, small ? 5 : 9)) {
    element(axes, "line", { x1: x(tick), x2: x(tick), y1: 12, y2: height - bottom });
    element(axes, "text", { x: x(tick), y: height - bottom + 18, "text-anchor": "middle" }, xText(tick));
  }
  for (const tick of steps(low, high, small ? 5 : 7)) {
    element(axes, "line", { x1: left, x2: width - right, y1: y(tick), y2: y(tick) });
    element(axes, "text", { x: left - 8, y: y(tick) + 4, "text-anchor": "end" }, yText(tick));
  }
  if (someInfinite) {
    element(axes, "line", { x1: left, x2: width - right, y1: 22, y2: 22, class: "infinite" });
    element(axes, "text", { x: left - 8, y: 26, "text-anchor": "end" }, "∞");
  }
  element(axes, "text", { x: (left + width - right) / 2, y: height - 8, "text-anchor": "middle", class: "title" }, xTitle);
  element(axes, "text", { x: -(top + height - bottom) / 2, y: 13, "text-anchor": "middle", class: "title", transform: "rotate(-90)" }, yTitle);
  if (Number.isFinite(threshold))
    element(axes, "line", { x1: left, x2: width - right, y1: y(threshold), y2: y(threshold), class: "threshold" });
  const line = front.map((index) => `${x(points[index].x)} ${y(points[index].y)}`);
  if (line.length > 1) element(axes, "path", { d: `M${line.join("L")}`, class: "front" });
  const order = [...points.keys()].sort((a, b) => points[a].x - points[b].x || points[a].y - points[b].y);
  const behindFirst = [...order].sort((a, b) => front.includes(a) - front.includes(b) || (a === selected) - (b === selected));
  for (const index of behindFirst) {
    const point = points[index], onFront = front.includes(index);
    const classes = ["point", `group${point.group % 6}`, onFront ? "on-front" : "", index === selected ? "selected" : ""];
    const mark = element(svg, "g", {
      class: classes.join(" ").trim(),
      role: "option",
      tabindex: index === selected ? 0 : -1,
      "aria-selected": index === selected,
      "aria-label": point.title,
      "data-key": point.key,
      transform: `translate(${x(point.x)} ${y(point.y)})`,
    });
    if (point.low !== null)
      element(mark, "line", { x1: x(point.low) - x(point.x), x2: x(point.high) - x(point.x), y1: 0, y2: 0, class: "spread" });
    element(mark, "circle", { r: 16, class: "target" });
    if (index === marked) element(mark, "circle", { r: 11, class: "ring" });
    element(mark, "path", { d: SHAPES[point.group % SHAPES.length](index === selected ? 7 : onFront ? 5.5 : 4.5), class: "shape" });
    const show = () => onPoint(index, x(point.x), y(point.y));
    mark.addEventListener("click", () => {
      onSelect(index);
      show();
    });
    mark.addEventListener("pointermove", (event) => {
      if (event.movementX || event.movementY) show(); // else only the chart has changed below a pointer at rest
    });
    mark.addEventListener("pointerleave", () => onPoint(null));
    mark.addEventListener("focus", show);
    mark.addEventListener("blur", () => onPoint(null));
  }
  svg.onkeydown = (event) => {
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    const place = order.indexOf(selected);
    let next = null;
    if (step) next = order[Math.min(Math.max(place + step, 0), order.length - 1)];
    if (event.key === "Home") next = order[0];
    if (event.key === "End") next = order[order.length - 1];
    if (next === null) return;
    event.preventDefault();
    onSelect(next);
    svg.querySelector("[tabindex='0']").focus();
  };
}
