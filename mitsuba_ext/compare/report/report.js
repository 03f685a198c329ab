// The image viewers of the report: flip-book, divider, zoom. One Viewer per scene, no globals.
"use strict";
(() => {
  const STEP = 1.25; // of the zoom
  const NUDGE = 0.02; // of the divider, per key press
  const CALM = 400; // ms without scrolling of the page after which the wheel may zoom

  let active = null; // the viewer that keys go to: below the pointer, or with the focus
  let scrolled = -Infinity; // when the wheel last scrolled the page

  const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

  class Viewer {
    constructor(root) {
      const all = (selector) => [...root.querySelectorAll(selector)];
      this.root = root.querySelector(".viewer");
      this.stage = root.querySelector(".stage");
      this.plane = root.querySelector(".plane");
      this.marks = root.querySelector(".marks");
      this.divider = root.querySelector(".divider");
      this.tags = all(".tag");
      this.scaleText = root.querySelector("output");
      this.select = root.querySelector("[data-other]");
      this.names = all(".tools [data-show]");
      this.layerButtons = all("[data-layer]");
      // The images are in the page once, below the viewer
      this.sources = all(".overview li").map((item) => ({
        image: item.querySelector("[data-open=image] img"),
        error: item.querySelector("[data-open=error] img"),
      }));
      this.layers = new Map(); // large copies of them, made when they are first shown
      this.width = Number(root.dataset.width);
      this.height = Number(root.dataset.height);

      this.shown = 0;
      this.other = null; // right of the divider
      this.layer = "image";
      this.split = 0.5; // of the stage's width
      this.fit();

      all("[data-show]").forEach((button) =>
        button.addEventListener("click", () => {
          const place = button.dataset.go;
          if (place) this.goTo(...place.split(" ").map(Number));
          this.show(Number(button.dataset.show), place ? "image" : this.layer);
        }));
      this.layerButtons.forEach((button) =>
        button.addEventListener("click", () => this.show(this.shown, button.dataset.layer)));
      all("[data-open]").forEach((button) =>
        button.addEventListener("click", () => {
          const index = this.sources.findIndex((source) =>
            button.contains(source[button.dataset.open]));
          this.show(index, button.dataset.open);
          this.root.scrollIntoView({ block: "nearest" });
        }));
      all("[data-zoom]").forEach((button) =>
        button.addEventListener("click", () => this.zoomButton(button.dataset.zoom)));
      this.select?.addEventListener("change", () => {
        this.other = this.select.value === "" ? null : Number(this.select.value);
        this.render();
      });
      root.querySelector("[data-marks]")?.addEventListener("change", (event) => {
        this.marks.hidden = !event.target.checked;
      });
      this.listenToPointer();
      for (const type of ["pointerenter", "focusin"]) {
        this.root.addEventListener(type, () => { active = this; });
      }
      for (const type of ["pointerleave", "focusout"]) {
        this.root.addEventListener(type, () => {
          if (active === this && !this.root.contains(document.activeElement)) active = null;
        });
      }
      this.divider.addEventListener("keydown", (event) => this.dividerKey(event));
      this.root.hidden = false;
      new ResizeObserver(() => this.render()).observe(this.stage);
      this.render();
    }

    show(index, layer = this.layer) {
      this.shown = clamp(index, 0, this.sources.length - 1);
      this.layer = layer;
      this.render();
    }

    // The view: a point of the image in the middle of the stage, and a factor beyond fitting

    fit() {
      this.zoom = 1;
      this.center = [this.width / 2, this.height / 2];
    }

    get fitScale() {
      return Math.min(
        this.stage.clientWidth / this.width, this.stage.clientHeight / this.height) || 1;
    }

    get scale() {
      return this.fitScale * this.zoom;
    }

    // Changes the zoom so that what is at (x, y) of the stage stays there
    zoomAt(factor, x = this.stage.clientWidth / 2, y = this.stage.clientHeight / 2) {
      const before = this.scale;
      this.zoom = clamp(this.zoom * factor, 1, Math.max(8, 64 / this.fitScale));
      const from = [x - this.stage.clientWidth / 2, y - this.stage.clientHeight / 2];
      this.center = this.center.map(
        (value, axis) => value + from[axis] / before - from[axis] / this.scale);
      this.render();
    }

    zoomButton(what) {
      if (what === "fit") this.fit();
      this.zoomAt({ in: STEP * STEP, out: 1 / (STEP * STEP), fit: 1 }[what]);
    }

    goTo(x, y, side) {
      this.center = [x + side / 2, y + side / 2];
      this.zoom = Math.max(1, 0.6 * this.height / side);
      this.root.scrollIntoView({ block: "nearest" });
    }

    // Keeps the stage filled: an axis on which the image is smaller stays centred
    clampCenter() {
      const half = [this.stage.clientWidth, this.stage.clientHeight].map(
        (size) => size / 2 / this.scale);
      this.center = [this.width, this.height].map((size, axis) =>
        2 * half[axis] >= size ? size / 2 : clamp(this.center[axis], half[axis], size - half[axis]));
    }

    render() {
      this.clampCenter();
      const { scale } = this;
      const { clientWidth, clientHeight } = this.stage;
      const left = clientWidth / 2 - this.center[0] * scale;
      const top = clientHeight / 2 - this.center[1] * scale;
      // Not a transform: it would enlarge the lines of the windows too
      const box = { left, top, width: this.width * scale, height: this.height * scale };
      for (const [name, value] of Object.entries(box)) this.plane.style[name] = `${value}px`;
      this.plane.classList.toggle("enlarged", scale * devicePixelRatio >= 1);
      this.stage.classList.toggle("zoomed", this.zoom > 1);
      this.scaleText.textContent = `${Math.round(100 * scale)} %`;

      const compares = this.other !== null && this.other !== this.shown;
      const visible = new Set([this.element(this.shown)]);
      if (compares) visible.add(this.element(this.other));
      for (const image of this.layers.values()) image.hidden = !visible.has(image);
      this.element(this.shown).style.clipPath = "";
      if (compares) {
        const cut = this.split * clientWidth - left;
        const image = this.element(this.other);
        image.style.clipPath = `inset(0 0 0 ${clamp(cut, 0, box.width)}px)`;
        this.plane.insertBefore(image, this.marks); // above the other one
      }
      this.divider.hidden = !compares;
      this.divider.style.left = `${100 * this.split}%`;
      this.divider.setAttribute("aria-valuenow", Math.round(100 * this.split));
      [this.shown, compares ? this.other : null].forEach((index, side) => {
        this.tags[side].textContent = index === null ? "" : this.describe(index);
      });
      this.names.forEach((button, index) =>
        button.setAttribute("aria-pressed", index === this.shown));
      this.layerButtons.forEach((button) =>
        button.setAttribute("aria-pressed", button.dataset.layer === this.layer));
    }

    // The reference has no error: it is shown instead, to flip between it and the errors
    source(index) {
      return this.sources[index][this.layer] ?? this.sources[index].image;
    }

    describe(index) {
      return this.source(index).alt;
    }

    element(index) {
      const source = this.source(index);
      if (!this.layers.has(source)) {
        const image = new Image();
        image.decoding = "sync"; // no blank frame in the flip-book
        image.draggable = false;
        image.alt = source.alt;
        image.src = source.src;
        this.layers.set(source, image);
        this.plane.insertBefore(image, this.marks);
      }
      return this.layers.get(source);
    }

    // Input

    listenToPointer() {
      let last = null; // where a drag was
      let moved = null; // what it moves
      this.stage.addEventListener("pointerdown", (event) => {
        if (event.button !== 0) return;
        moved = event.target === this.divider ? "divider" : "image";
        last = [event.clientX, event.clientY];
        this.stage.setPointerCapture(event.pointerId);
      });
      this.stage.addEventListener("pointermove", (event) => {
        if (last === null) return;
        const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
        last = [event.clientX, event.clientY];
        if (moved === "divider") {
          const box = this.stage.getBoundingClientRect();
          this.split = clamp((event.clientX - box.left) / box.width, 0, 1);
        } else {
          this.center = [this.center[0] - dx / this.scale, this.center[1] - dy / this.scale];
        }
        this.render();
      });
      for (const type of ["pointerup", "pointercancel"]) {
        this.stage.addEventListener(type, () => { last = null; });
      }
      this.stage.addEventListener("wheel", (event) => {
        // The wheel scrolls the page, instead of zooming, shortly after it has scrolled the page, and
        // when it would zoom out beyond the whole image
        const outwards = event.deltaY > 0;
        if (event.timeStamp - scrolled < CALM || (outwards && this.zoom === 1)) return;
        event.preventDefault();
        event.stopPropagation();
        const box = this.stage.getBoundingClientRect();
        this.zoomAt(outwards ? 1 / STEP : STEP, event.clientX - box.left, event.clientY - box.top);
      }, { passive: false });
    }

    dividerKey(event) {
      const nudge = { ArrowLeft: -NUDGE, ArrowRight: NUDGE, Home: -1, End: 1 }[event.key];
      if (nudge === undefined) return;
      this.split = clamp(this.split + nudge, 0, 1);
      this.render();
      event.preventDefault();
      event.stopPropagation(); // else the arrows would also switch images
    }

    // Handles a key; returns whether it had a meaning
    key(name) {
      const count = this.sources.length;
      if (name >= "1" && name <= "9") {
        if (Number(name) <= count) this.show(Number(name) - 1);
      } else if (name === "ArrowLeft" || name === "ArrowRight") {
        this.show((this.shown + (name === "ArrowLeft" ? count - 1 : 1)) % count);
      } else if (name === "e" || name === "E") {
        if (this.layerButtons.length) this.show(this.shown, this.layer === "image" ? "error" : "image");
      } else if (name === "+" || name === "=") this.zoomButton("in");
      else if (name === "-") this.zoomButton("out");
      else if (name === "0") this.zoomButton("fit");
      else return false;
      return true;
    }
  }

  document.querySelectorAll("[data-viewer]").forEach((root) => new Viewer(root));

  document.addEventListener("wheel", (event) => { scrolled = event.timeStamp; }, { passive: true });
  document.addEventListener("keydown", (event) => {
    const isElsewhere = event.altKey || event.ctrlKey || event.metaKey
      || event.target.closest?.("select, input, textarea");
    if (active && !isElsewhere && active.key(event.key)) event.preventDefault();
  });
})();
