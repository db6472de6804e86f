// The page: what is chosen, and the tables.

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const names = Object.keys(data.contenders);
const state = { scene: Object.keys(data.scenes)[0], point: 0, against: "reference" };
const exposures = {};

function node(name, attributes = {}, ...children) {
  const result = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) result.addEventListener(key.slice(2), value);
    else result.setAttribute(key, value);
  }
  result.append(...children);
  return result;
}

const scene = () => data.scenes[state.scene];
const title = (point) => `${point.contender}, ${point.label}`;

const viewer = new Viewer({
  stage: $("stage"), canvas: $("canvas"), tagA: $("tag-a"), tagB: $("tag-b"), pixel: $("pixel"), scale: $("scale"),
  onMode: setMode, onExposure: (stops) => setExposure(viewer.exposure + stops),
});
const chart = new Chart($("plot"), $("tip"), names, pick);

function setMode(mode) {
  viewer.choose(mode);
  for (const button of $("modes").children) check(button, button.dataset.mode === mode);
}

function setExposure(stops) {
  const limited = Math.min(12, Math.max(-6, stops));
  exposures[state.scene] = limited;
  $("exposure").value = limited;
  $("stops").textContent = `${limited >= 0 ? "+" : "−"}${Math.abs(limited).toFixed(2)} EV`;
  viewer.expose(limited);
}

function check(button, checked) {
  button.setAttribute("aria-checked", checked);
  button.setAttribute("tabindex", checked ? 0 : -1);
}

// A group of buttons of which one is chosen, by click or by arrows.
function choice(box, items, key, choose) {
  for (const [value, text] of items) {
    box.append(node("button", { role: "radio", [`data-${key}`]: value, onclick: () => choose(value) }, text));
  }
  box.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    const buttons = [...box.children];
    if (!step) return;
    event.preventDefault();
    const next = buttons[(buttons.indexOf(document.activeElement) + step + buttons.length) % buttons.length];
    next.focus();
    choose(next.dataset[key]);
  });
}

function chooseScene(name) {
  state.scene = name;
  for (const button of $("scenes").children) check(button, button.dataset.scene === name);
  const points = scene().points;
  $("against").replaceChildren(
    node("option", { value: "reference" }, `reference, ${scene().reference.spp} spp`),
    ...points.map((point, index) => node("option", { value: index }, title(point))),
  );
  // the middle of the front: neither the cheapest nor the slowest
  const front = scene().front;
  const start = front.length ? front[Math.floor(front.length / 2)] : 0;
  state.against = "reference";
  chart.show(scene(), start);
  $("front").replaceChildren("Pareto front, fast to good: ");
  front.forEach((index, i) => {
    $("front").append(i ? ", " : "", node("button", { onclick: () => chart.pick(index) }, title(points[index])));
  });
  tables();
  pick(start);
}

async function pick(index) {
  state.point = index;
  const { points, reference, width, height } = scene();
  const point = points[index];
  if (!point) return;
  details(point);
  const other = state.against === "reference" ? null : points[Number(state.against)];
  const [a, b, truth] = await Promise.all([picture(point.picture), picture(other ? other.picture : reference.picture), picture(reference.picture)]);
  if (state.point !== index) return; // another one was picked meanwhile
  if (!(state.scene in exposures)) exposures[state.scene] = autoExposure(truth);
  setExposure(exposures[state.scene]);
  viewer.show({ name: title(point), radiance: a }, { name: other ? title(other) : "reference", radiance: b }, width, height);
  document.body.dataset.shown = `${state.scene} ${index} ${state.against}`;
}

function details(point) {
  const numbers = {
    "seconds, warm": short(point.seconds),
    compile: `${short(point.compile_seconds)} s`,
    relMSE: `${point.at_floor ? "≤ " : ""}${short(point.relmse)}`,
    PSNR: `${short(point.psnr)} dB`,
    FLIP: short(point.flip),
  };
  for (const [stage, seconds] of Object.entries(point.timings)) if (seconds >= 0.0005) numbers[stage] = `${short(seconds)} s`;
  for (const [kind, count] of Object.entries(point.counts)) if (count) numbers[kind.replaceAll("_", " ")] = count.toLocaleString("en");
  const list = node("dl");
  for (const [name, value] of Object.entries(numbers)) list.append(node("div", {}, node("dt", {}, name), node("dd", {}, value)));
  $("details").replaceChildren(node("h2", {}, title(point)), list);
  if (point.at_floor) $("details").append(node("p", {}, "Its error is lost in the reference's own noise."));
  if (point.command) $("details").append(node("code", {}, point.command));
}

function tables() {
  const box = $("tables");
  box.replaceChildren();
  const kinds = [["equal_time", "relMSE at equal time", (x) => `${short(x)} s`], ["equal_error", "Seconds at equal relMSE", short]];
  for (const [kind, caption, heading] of kinds) {
    const { columns, rows, best } = scene()[kind];
    const table = node("table", {}, node("caption", {}, caption));
    table.append(node("tr", {}, node("th"), ...columns.map((x) => node("th", { scope: "col" }, heading(x)))));
    for (const [name, row] of Object.entries(rows)) {
      const cells = row.map((x, i) => {
        const base = rows.path?.[i];
        const ratio = x === null || !base || name === "path" ? "" : `×${Number((x / base).toPrecision(2))}`;
        return node("td", name === best[i] ? { class: "best" } : {}, short(x), ratio ? node("small", {}, ratio) : "");
      });
      table.append(node("tr", {}, node("th", { scope: "row" }, name), ...cells));
    }
    box.append(node("div", {}, table));
  }
  box.append(node("p", { class: "hint" }, "On each method's own line, straight where both axes are logarithmic; × is against path. A dash: not measured there, and nothing is guessed."));
}

function stability() {
  const box = $("stability");
  box.append(node("h2", {}, "Known failures"));
  if (!data.stability) {
    box.append(node("p", { class: "hint" }, "Not measured here: python -m bench stability with the same --out adds them."));
    return;
  }
  const table = node("table", {}, node("tr", {}, ...["method", "scene", "what is measured", "value", "bound", ""].map((t, i) => node("th", { scope: "col", class: i < 3 ? "text" : "" }, t))));
  for (const row of data.stability.rows) {
    const value = row.error ? `${short(row.value)} ± ${short(Number(row.error.toPrecision(2)))}` : short(row.value);
    table.append(node("tr", {}, node("td", { class: "text" }, row.method), node("td", { class: "text" }, row.scene), node("td", { class: "text" }, row.what),
      node("td", {}, value), node("td", {}, row.bound === null ? "none" : `≤ ${short(row.bound)}`), node("td", { class: row.verdict }, row.verdict)));
  }
  box.append(table);
}

function provenance() {
  const { device_name, cpu, threads, date, commit, dirty, settings, versions, notes, contenders, system } = data;
  $("circumstances").textContent = [
    `${settings.size.join(" × ")} pixels`, `${cpu}${device_name === "CPU" || device_name === cpu ? "" : `, ${device_name}`}`, `${threads} threads`,
    date.replace("T", " ").replace("+00:00", " UTC"), commit ? `commit ${commit.slice(0, 10)}${dirty ? " with changes" : ""}` : "",
  ].filter(Boolean).join(" · ");
  const box = $("provenance");
  box.append(node("h2", {}, "How it was made"));
  for (const note of notes) box.append(node("p", { class: "hint" }, note));
  for (const [name, item] of Object.entries(data.scenes)) {
    const { spp, seconds, noise } = item.reference;
    box.append(node("p", { class: "hint" }, `${name}: reference of ${spp} paths per pixel in ${short(seconds)} s; its own noise, relMSE ${short(noise.relmse)}, is taken off every error, and points below it are hollow.`));
  }
  box.append(node("p", { class: "hint" }, "Errors and seconds are those of the full float32 pictures; pictures on this page are rounded to 1/256 of each value."));
  const record = { settings, versions, contenders, system };
  box.append(node("details", {}, node("summary", {}, "Settings and versions"), node("pre", {}, JSON.stringify(record, null, 2))));
}

choice($("scenes"), Object.keys(data.scenes).map((name) => [name, name]), "scene", chooseScene);
choice($("modes"), Object.entries(MODES), "mode", setMode);
names.forEach((name, index) => {
  const icon = svg("svg", { viewBox: "-13 -7 26 14" });
  svg("line", { x1: -13, x2: 13, y1: 0, y2: 0, stroke: colour(index), "stroke-width": 2 }, icon);
  svg("path", { d: marker(index), fill: colour(index) }, icon);
  const button = node("button", { "aria-pressed": true, title: "Click: show or hide. Double-click: this one alone, or all." }, icon, name);
  const update = () => {
    [...$("legend").children].forEach((other, i) => other.setAttribute("aria-pressed", !chart.hidden.has(names[i])));
    chart.draw();
  };
  button.addEventListener("click", () => {
    chart.hidden.has(name) ? chart.hidden.delete(name) : chart.hidden.add(name);
    update();
  });
  button.addEventListener("dblclick", () => {
    const alone = names.every((other) => chart.hidden.has(other) === (other !== name));
    chart.hidden = new Set(alone ? [] : names.filter((other) => other !== name));
    update();
  });
  $("legend").append(button);
});
$("metric").addEventListener("change", (event) => {
  chart.metric = event.target.value;
  chart.draw();
});
$("against").addEventListener("change", (event) => {
  state.against = event.target.value;
  pick(state.point);
});
$("exposure").addEventListener("input", (event) => setExposure(Number(event.target.value)));
$("in").addEventListener("click", () => viewer.zoomTo(viewer.zoom * 1.5));
$("out").addEventListener("click", () => viewer.zoomTo(viewer.zoom / 1.5));
$("one").addEventListener("click", () => viewer.zoomTo(1 / (window.devicePixelRatio || 1)));
$("fit").addEventListener("click", () => viewer.fit());
setMode("split");
stability();
provenance();
chooseScene(state.scene);
