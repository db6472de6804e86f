// The chart: one line a contender, both axes logarithmic but for PSNR and FLIP.

const COLOURS = ["#5ab8f5", "#ffa62b", "#3ddc97", "#f086c6", "#f4e04d", "#ff7059", "#b79cff", "#a3d65c", "#ffffff", "#c9a27e"];
const MARKERS = [
  "M-5 0A5 5 0 1 0 5 0A5 5 0 1 0-5 0Z", "M-4.5-4.5H4.5V4.5H-4.5Z", "M0-6.4L6.4 0L0 6.4L-6.4 0Z", "M0-6L5.8 4.6H-5.8Z",
  "M0 6L5.8-4.6H-5.8Z", "M-1.9-6H1.9V-1.9H6V1.9H1.9V6H-1.9V1.9H-6V-1.9H-1.9Z",
];
const METRICS = {
  relmse: { title: "relMSE", log: true, better: -1 },
  psnr: { title: "PSNR [dB]", log: false, better: 1 },
  flip: { title: "FLIP", log: true, better: -1 },
};
const MARGIN = { left: 62, right: 16, top: 12, bottom: 42 };

const colour = (index) => COLOURS[index % COLOURS.length];
const marker = (index) => MARKERS[index % MARKERS.length];

function svg(name, attributes = {}, parent = null, text = "") {
  const node = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text) node.textContent = text;
  if (parent) parent.append(node);
  return node;
}

function axis(values, log, from, to) {
  let low = Math.min(...values);
  let high = Math.max(...values);
  const map = log ? Math.log10 : (x) => x;
  let [a, b] = [map(low), map(high)];
  const pad = 0.06 * (b - a) || (log ? 0.3 : 1);
  [a, b] = [a - pad, b + pad];
  const place = (x) => from + ((map(x) - a) / (b - a)) * (to - from);
  const major = [];
  const minor = [];
  if (log) {
    const wide = b - a > 1.2;
    for (let decade = Math.floor(a); decade <= Math.ceil(b); decade++) {
      for (let step = 1; step < 10; step++) {
        const x = Number(`${step}e${decade}`);
        if (map(x) < a || map(x) > b) continue;
        (step === 1 || (!wide && (step === 2 || step === 5)) ? major : minor).push(x);
      }
    }
  } else {
    const step = [1, 2, 5, 10, 20].find((s) => (b - a) / s <= 7) || 50;
    for (let x = Math.ceil(a / step) * step; x <= b; x += step) major.push(x);
  }
  return { place, major, minor };
}

const short = (x) => (x === null || x === undefined ? "–" : Math.abs(x) >= 1e-4 || x === 0 ? String(Number(x.toPrecision(3))) : x.toExponential(1));

class Chart {
  constructor(box, tip, names, onPick) {
    Object.assign(this, { box, tip, names, onPick, hidden: new Set(), metric: "relmse", scene: null, selected: 0 });
    new ResizeObserver(() => this.draw()).observe(box);
  }

  show(scene, selected) {
    this.scene = scene;
    this.selected = selected;
    this.draw();
  }

  value(point) {
    return point[this.metric];
  }

  visible() {
    const points = this.scene.points.map((point, index) => ({ point, index }));
    const shown = points.filter(({ point }) => !this.hidden.has(point.contender));
    return shown.filter(({ point }) => this.value(point) !== null && (!METRICS[this.metric].log || this.value(point) > 0));
  }

  draw() {
    if (!this.scene) return;
    const focused = this.box.contains(document.activeElement);
    const width = Math.max(280, this.box.clientWidth);
    const height = Math.max(300, Math.min(560, 0.72 * width));
    this.box.replaceChildren();
    const root = svg("svg", { viewBox: `0 0 ${width} ${height}`, height, role: "group", "aria-label": "Points; arrows go from one to the next" }, this.box);
    const shown = this.visible();
    if (!shown.length) {
      svg("text", { x: width / 2, y: height / 2, "text-anchor": "middle" }, root, "nothing to show");
      return;
    }
    const metric = METRICS[this.metric];
    // all points of the scene, so that the axes stay where they are when lines come and go
    const every = this.scene.points.filter((p) => this.value(p) !== null && (!metric.log || this.value(p) > 0));
    const x = axis(every.map((p) => p.seconds), true, MARGIN.left, width - MARGIN.right);
    const y = axis(every.map((p) => this.value(p)), metric.log, height - MARGIN.bottom, MARGIN.top);
    this.grid(root, x, y, width, height, metric);

    const place = (point) => `${x.place(point.seconds).toFixed(1)} ${y.place(this.value(point)).toFixed(1)}`;
    if (this.metric === "relmse") {
      const front = this.scene.front.map((i) => this.scene.points[i]).filter((p) => !this.hidden.has(p.contender));
      if (front.length) svg("path", { class: "front", d: `M${front.map(place).join("L")}` }, root);
      const noise = this.scene.reference.noise.relmse;
      if (this.scene.points.some((p) => p.at_floor)) {
        const level = y.place(noise);
        svg("line", { class: "noise", x1: MARGIN.left, x2: width - MARGIN.right, y1: level, y2: level }, root);
        svg("text", { x: MARGIN.left + 4, y: level - 5 }, root, "noise of the reference");
      }
    }
    for (const [name, indices] of Object.entries(this.scene.lines)) {
      const line = indices.map((i) => this.scene.points[i]).filter((p) => this.value(p) !== null);
      if (this.hidden.has(name) || line.length < 2) continue;
      svg("path", { class: "line", stroke: colour(this.names.indexOf(name)), d: `M${line.map(place).join("L")}` }, root);
    }
    this.nodes = new Map();
    for (const { point, index } of shown) this.nodes.set(index, this.dot(root, point, index, place(point)));
    if (focused) this.nodes.get(this.selected)?.focus();
  }

  grid(root, x, y, width, height, metric) {
    const [left, right, top, bottom] = [MARGIN.left, width - MARGIN.right, MARGIN.top, height - MARGIN.bottom];
    for (const kind of ["minor", "major"]) {
      for (const value of x[kind]) svg("line", { class: kind, x1: x.place(value), x2: x.place(value), y1: top, y2: bottom }, root);
      for (const value of y[kind]) svg("line", { class: kind, x1: left, x2: right, y1: y.place(value), y2: y.place(value) }, root);
    }
    for (const value of x.major) svg("text", { x: x.place(value), y: bottom + 18, "text-anchor": "middle" }, root, short(value));
    for (const value of y.major) svg("text", { x: left - 8, y: y.place(value) + 4, "text-anchor": "end" }, root, short(value));
    svg("text", { x: (left + right) / 2, y: height - 6, "text-anchor": "middle" }, root, "seconds");
    const better = metric.better < 0 ? "lower is better" : "higher is better";
    svg("text", { transform: `translate(13 ${(top + bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }, root, `${metric.title}, ${better}`);
  }

  dot(root, point, index, place) {
    const which = this.names.indexOf(point.contender);
    const node = svg("g", {
      class: `point${index === this.selected ? " selected" : ""}`,
      transform: `translate(${place})`,
      tabindex: index === this.selected ? 0 : -1,
      role: "button",
      "data-index": index,
      "aria-pressed": index === this.selected,
      "aria-label": `${point.contender}, ${point.label}: ${short(point.seconds)} seconds, relMSE ${short(point.relmse)}`,
    }, root);
    svg("circle", { class: "hit", r: 13 }, node);
    svg("circle", { class: "halo", r: 10 }, node);
    const fill = point.at_floor ? { fill: "none", stroke: colour(which), "stroke-width": 1.6 } : { fill: colour(which), stroke: "#1b1b1b" };
    svg("path", { d: marker(which), ...fill }, node);
    node.addEventListener("pointerenter", () => this.hint(node, point));
    node.addEventListener("pointerleave", () => (this.tip.hidden = true));
    node.addEventListener("focus", () => node.matches(":focus-visible") && this.hint(node, point));
    node.addEventListener("blur", () => (this.tip.hidden = true));
    node.addEventListener("click", () => this.pick(index));
    node.addEventListener("keydown", (event) => this.key(event, index));
    return node;
  }

  pick(index) {
    this.selected = index;
    for (const [i, node] of this.nodes) {
      node.classList.toggle("selected", i === index);
      node.setAttribute("aria-pressed", i === index);
      node.setAttribute("tabindex", i === index ? 0 : -1);
    }
    this.onPick(index);
  }

  // left and right along a line, up and down to the next line, at the nearest time
  key(event, index) {
    const points = this.scene.points;
    const shown = this.visible().map((item) => item.index);
    const here = points[index];
    const line = (name) => shown.filter((i) => points[i].contender === name).sort((a, b) => points[a].seconds - points[b].seconds);
    const names = this.names.filter((name) => line(name).length);
    let next = index;
    if (event.key === "Enter" || event.key === " ") {
      this.pick(index);
    } else if (event.key === "ArrowRight" || event.key === "ArrowLeft") {
      const mine = line(here.contender);
      next = mine[mine.indexOf(index) + (event.key === "ArrowRight" ? 1 : -1)] ?? index;
    } else if (event.key === "ArrowUp" || event.key === "ArrowDown") {
      const step = event.key === "ArrowDown" ? 1 : names.length - 1;
      const name = names[(names.indexOf(here.contender) + step) % names.length];
      const apart = (i) => Math.abs(Math.log(points[i].seconds / here.seconds));
      next = line(name).reduce((a, b) => (apart(b) < apart(a) ? b : a));
    } else {
      return;
    }
    event.preventDefault();
    if (next !== index) {
      this.pick(next);
      this.nodes.get(next).focus();
    }
  }

  hint(node, point) {
    const rows = [
      `${short(point.seconds)} s (${short(point.seconds_low)}–${short(point.seconds_high)})`,
      `relMSE ${point.at_floor ? "≤ " : ""}${short(point.relmse)}`,
      `PSNR ${short(point.psnr)} dB${point.flip === null ? "" : `, FLIP ${short(point.flip)}`}`,
    ];
    const head = document.createElement("b");
    head.textContent = point.contender;
    const settings = document.createElement("div");
    settings.textContent = point.label;
    const numbers = document.createElement("div");
    numbers.className = "dim";
    numbers.textContent = rows.join(" · ");
    this.tip.replaceChildren(head, settings, numbers);
    this.tip.hidden = false;
    const from = node.getBoundingClientRect();
    const size = this.tip.getBoundingClientRect();
    const middle = from.left + from.width / 2;
    this.tip.style.left = `${Math.max(6, Math.min(innerWidth - size.width - 6, middle - size.width / 2))}px`;
    const above = from.top - size.height - 8;
    this.tip.style.top = `${above > 6 ? above : from.bottom + 8}px`;
  }
}
