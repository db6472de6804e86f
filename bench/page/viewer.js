// The viewer: two pictures of one place, by a divider, in turn, side by side, or their difference.

const MODES = { split: "Divider", flip: "Flip", side: "Side by side", error: "Error" };

class Viewer {
  constructor(parts) {
    Object.assign(this, parts, { mode: "split", flipped: false, divider: 0.5, exposure: 0, a: null, b: null });
    this.layers = { a: document.createElement("canvas"), b: document.createElement("canvas"), error: document.createElement("canvas") };
    new ResizeObserver(() => this.resize()).observe(this.stage);
    const stage = this.stage;
    stage.addEventListener("pointerdown", (event) => this.down(event));
    stage.addEventListener("pointermove", (event) => this.move(event));
    stage.addEventListener("pointerup", () => (this.drag = null));
    stage.addEventListener("pointercancel", () => (this.drag = null));
    stage.addEventListener("pointerleave", () => (this.pixel.textContent = ""));
    stage.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    stage.addEventListener("dblclick", () => this.fit());
    stage.addEventListener("keydown", (event) => this.key(event));
    const ramp = INFERNO.map((c, i) => `${c} ${(100 * i) / (INFERNO.length - 1)}%`).join(", ");
    this.scale.querySelector("i").style.background = `linear-gradient(90deg, ${ramp})`;
  }

  // a and b: { name, radiance }; b is what a is compared with
  show(a, b, width, height) {
    const same = this.width === width && this.height === height;
    Object.assign(this, { a, b, width, height });
    for (const layer of Object.values(this.layers)) if (layer.width !== width || layer.height !== height) Object.assign(layer, { width, height });
    this.paint("error", (out) => falseColour(relativeSquares(a.radiance, b.radiance), out));
    this.expose(this.exposure);
    if (!same) this.resize();
  }

  paint(name, fill) {
    const context = this.layers[name].getContext("2d");
    const image = context.createImageData(this.width, this.height);
    fill(image.data);
    context.putImageData(image, 0, 0);
  }

  expose(stops) {
    this.exposure = stops;
    if (!this.a) return;
    for (const name of ["a", "b"]) this.paint(name, (out) => toneMap(this[name].radiance, stops, out));
    this.draw();
  }

  choose(mode) {
    this.mode = mode;
    this.resize();
  }

  resize() {
    if (!this.a) return;
    const ratio = window.devicePixelRatio || 1;
    const width = this.stage.clientWidth;
    const aspect = this.height / this.width / (this.mode === "side" ? 2 : 1);
    const height = Math.round(Math.min(width * aspect, Math.max(240, 0.8 * innerHeight)));
    Object.assign(this.canvas, { width: Math.round(width * ratio), height: Math.round(height * ratio) });
    this.canvas.style.height = `${height}px`;
    this.fit();
  }

  // width and height of a panel in CSS pixels
  panel() {
    const box = this.canvas.getBoundingClientRect();
    return [box.width / (this.mode === "side" ? 2 : 1), box.height];
  }

  fit() {
    const [width, height] = this.panel();
    this.zoomTo(Math.min(width / this.width, height / this.height));
    Object.assign(this, { x: this.width / 2, y: this.height / 2 });
    this.draw();
  }

  zoomTo(zoom, at = null) {
    const before = at && this.toPixel(...at);
    this.zoom = Math.min(64, Math.max(0.25, zoom));
    if (before) {
      const after = this.toPixel(...at);
      this.x += before[0] - after[0];
      this.y += before[1] - after[1];
    }
    this.draw();
  }

  toPixel(left, top) {
    const [width, height] = this.panel();
    const inside = this.mode === "side" ? left % width : left;
    return [this.x + (inside - width / 2) / this.zoom, this.y + (top - height / 2) / this.zoom];
  }

  draw() {
    if (!this.a || !this.zoom) return;
    const context = this.canvas.getContext("2d");
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = this.panel();
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = "#333";
    context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    context.imageSmoothingEnabled = this.zoom < 1;
    const place = (layer, left, from, to) => {
      context.save();
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      context.beginPath();
      context.rect(from, 0, to - from, height);
      context.clip();
      const corner = [left + width / 2 - this.x * this.zoom, height / 2 - this.y * this.zoom];
      context.drawImage(this.layers[layer], ...corner, this.width * this.zoom, this.height * this.zoom);
      context.restore();
    };
    const cut = this.divider * width;
    if (this.mode === "split") {
      place("a", 0, 0, cut);
      place("b", 0, cut, width);
    } else if (this.mode === "side") {
      place("a", 0, 0, width);
      place("b", width, width, 2 * width);
    } else {
      place(this.mode === "error" ? "error" : this.flipped ? "b" : "a", 0, 0, width);
    }
    if (this.mode === "split" || this.mode === "side") {
      context.fillStyle = "#fff";
      context.fillRect(Math.round((this.mode === "side" ? width : cut) * ratio) - 1, 0, 2, this.canvas.height);
    }
    const flipped = this.mode === "flip" && this.flipped;
    this.tagA.textContent = flipped ? "" : this.mode === "error" ? `${this.a.name} – ${this.b.name}` : this.a.name;
    this.tagB.textContent = this.mode === "error" || (this.mode === "flip" && !this.flipped) ? "" : this.b.name;
    this.scale.hidden = this.mode !== "error";
    this.stage.dataset.mode = this.mode;
    this.stage.dataset.flipped = this.flipped;
  }

  spot(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  down(event) {
    const [left, top] = this.spot(event);
    const cut = this.divider * this.canvas.getBoundingClientRect().width;
    this.stage.focus({ preventScroll: true });
    this.stage.setPointerCapture(event.pointerId);
    this.drag = { divider: this.mode === "split" && Math.abs(left - cut) < 14, left, top, x: this.x, y: this.y, moved: false };
    event.preventDefault();
    if (this.mode === "flip") this.stage.addEventListener("pointerup", () => this.drag?.moved || this.flip(), { once: true, capture: true });
  }

  move(event) {
    if (!this.a) return;
    const [left, top] = this.spot(event);
    const width = this.canvas.getBoundingClientRect().width;
    const near = this.mode === "split" && Math.abs(left - this.divider * width) < 14;
    this.stage.style.cursor = near ? "ew-resize" : "crosshair";
    if (this.drag?.divider) {
      this.divider = Math.min(1, Math.max(0, left / width));
      this.draw();
    } else if (this.drag) {
      this.drag.moved ||= Math.hypot(left - this.drag.left, top - this.drag.top) > 3;
      this.x = this.drag.x - (left - this.drag.left) / this.zoom;
      this.y = this.drag.y - (top - this.drag.top) / this.zoom;
      this.draw();
    }
    this.read(left, top);
  }

  read(left, top) {
    const [x, y] = this.toPixel(left, top).map(Math.floor);
    if (x < 0 || y < 0 || x >= this.width || y >= this.height) {
      this.pixel.textContent = "";
      return;
    }
    const start = 3 * (y * this.width + x);
    const text = (side) => [...this[side].radiance.slice(start, start + 3)].map((v) => v.toPrecision(3)).join("  ");
    this.pixel.textContent = `${x}, ${y}\n${text("a")}  ${this.a.name}\n${text("b")}  ${this.b.name}`;
  }

  flip() {
    this.flipped = !this.flipped;
    this.draw();
  }

  wheel(event) {
    if (!this.a) return;
    event.preventDefault();
    const spot = this.spot(event);
    this.zoomTo(this.zoom * 2 ** (-event.deltaY / 240), spot);
    this.read(...spot);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const mode = Object.keys(MODES)[Number(event.key) - 1];
    const left = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (mode) this.onMode(mode);
    else if (event.key === " ") this.mode === "flip" ? this.flip() : this.onMode("flip");
    else if (event.key === "+" || event.key === "=") this.zoomTo(this.zoom * 1.5);
    else if (event.key === "-") this.zoomTo(this.zoom / 1.5);
    else if (event.key === "0") this.fit();
    else if (event.key === "e") this.onExposure(0.5);
    else if (event.key === "d") this.onExposure(-0.5);
    else if (left && this.mode === "split") {
      this.divider = Math.min(1, Math.max(0, this.divider + 0.05 * left));
      this.draw();
    } else if (left && this.mode === "flip") this.flip();
    else return;
    event.preventDefault();
  }
}
