// Shows a running render: asks for its state once a second, and for the pixels that have changed.
"use strict";
(() => {
  const PERIOD = 1000; // ms between two questions
  const PATIENCE = 3; // questions without an answer after which the render counts as gone
  const AUTO_SHARE = 0.95; // Auto exposes this share of the pixels below …
  const AUTO_WHITE = 0.8; // … this fraction of white

  const $ = (id) => document.getElementById(id);
  const BAD = [255, 0, 200]; // pixels that are not finite
  const COLORS = JSON.parse(document.body.dataset.colors);
  const KEY = location.hash.slice(1);
  const PAGE = Math.random().toString(36).slice(2);

  let state = null;
  let misses = 0;
  let shown = { name: null, layer: null, number: 0 }; // what the canvas shows
  let chosen = null; // the name of the image that the user has chosen
  let layer = "image";
  let pixels = null; // 16-bit floats as integers
  let size = [16, 9];
  let timer = null;

  // 16-bit floats

  const VALUES = new Float32Array(65536);
  for (let bits = 0; bits < 65536; bits++) {
    const sign = bits & 0x8000 ? -1 : 1;
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    if (exponent === 31) VALUES[bits] = fraction ? NaN : sign * Infinity;
    else if (exponent === 0) VALUES[bits] = sign * fraction * 2 ** -24;
    else VALUES[bits] = sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
  }

  const srgb = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);

  // Text

  const short = (x, digits = 3) => {
    if (x === 0) return "0";
    const size = Math.abs(x);
    return size >= 1e5 || size < 1e-3 ? x.toExponential(digits - 1) : String(Number(x.toPrecision(digits)));
  };
  const duration = (seconds) => {
    if (seconds < 10) return `${seconds.toFixed(1)} s`;
    const s = Math.round(seconds);
    const two = (x) => String(x).padStart(2, "0");
    if (s < 60) return `${s} s`;
    return s < 3600 ? `${Math.floor(s / 60)}:${two(s % 60)} min`
      : `${Math.floor(s / 3600)}:${two(Math.floor(s / 60) % 60)}:${two(s % 60)} h`;
  };

  function list(element, rows) {
    element.replaceChildren(...rows.map(([term, text]) => {
      const row = document.createElement("div");
      const dt = document.createElement("dt");
      const dd = document.createElement("dd");
      dt.textContent = term;
      dd.textContent = text;
      row.append(dt, dd);
      return row;
    }));
    element.hidden = rows.length === 0;
  }

  // The canvas

  const canvas = $("canvas");
  const context = canvas.getContext("2d");

  function draw() {
    if (pixels === null) return;
    const [width, height] = size;
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    const out = context.createImageData(width, height);
    if (shown.layer === "error") drawErrors(out.data);
    else drawImage(out.data);
    context.putImageData(out, 0, 0);
    fit();
  }

  function drawImage(data) {
    const factor = 2 ** Number($("exposure").value);
    const table = new Uint8ClampedArray(65536);
    for (let bits = 0; bits < 65536; bits++) {
      const value = VALUES[bits] * factor;
      table[bits] = value > 0 ? Math.round(255 * srgb(Math.min(value, 1))) : 0;
    }
    const isBad = (bits) => (bits & 0x7c00) === 0x7c00; // NaN and infinity: the largest exponent
    for (let i = 0, o = 0; i < pixels.length; i += 3, o += 4) {
      const [r, g, b] = [pixels[i], pixels[i + 1], pixels[i + 2]];
      data[o] = table[r];
      data[o + 1] = table[g];
      data[o + 2] = table[b];
      data[o + 3] = 255;
      if (isBad(r) || isBad(g) || isBad(b)) data.set(BAD, o);
    }
  }

  let limit = 1; // of the colours of errors

  function drawErrors(data) {
    const finite = Array.from(pixels, (bits) => VALUES[bits]).filter(Number.isFinite);
    finite.sort((a, b) => a - b);
    limit = finite[Math.floor(0.99 * (finite.length - 1))] || 1;
    for (let i = 0, o = 0; i < pixels.length; i++, o += 4) {
      const value = VALUES[pixels[i]] / limit;
      const color = Number.isFinite(value)
        ? COLORS[Math.min(255, Math.max(0, Math.round(255 * value)))] : BAD;
      data.set(color, o);
      data[o + 3] = 255;
    }
    $("scale-end").textContent = `${short(100 * limit, 2)} % of the brightness`;
  }

  function fit() {
    const zoom = Number($("zoom").value);
    const [width, height] = size;
    const ratio = devicePixelRatio || 1;
    canvas.style.width = zoom ? `${(width * zoom) / ratio}px` : "";
    canvas.style.height = zoom ? `${(height * zoom) / ratio}px` : "";
    $("frame").style.setProperty("--ratio", width / height);
    $("frame").classList.toggle("fit", !zoom);
    $("frame").classList.toggle("zoomed", zoom > 0);
    $("frame").classList.toggle("enlarged", zoom > 1 || (!zoom && canvas.clientWidth > width));
  }

  function autoExposure() {
    if (pixels === null || shown.layer !== "image") return;
    const values = [];
    const step = 3 * Math.max(1, Math.floor(pixels.length / 3 / 100000));
    for (let i = 0; i < pixels.length; i += step) {
      const [r, g, b] = [0, 1, 2].map((c) => VALUES[pixels[i + c]]);
      const luminance = 0.2126 * r + 0.7152 * g + 0.0722 * b;
      if (Number.isFinite(luminance)) values.push(luminance);
    }
    values.sort((a, b) => a - b);
    const bright = values[Math.floor(AUTO_SHARE * (values.length - 1))] || values[values.length - 1];
    if (bright > 0) expose(Math.log2(AUTO_WHITE / bright));
  }

  function expose(stops) {
    $("exposure").value = stops;
    showExposure();
  }

  function showExposure() {
    const stops = Number($("exposure").value);
    $("stops").textContent = `${stops > 0 ? "+" : ""}${Number(stops.toFixed(1))} EV`;
    draw();
  }

  function readPixel(event) {
    if (pixels === null) return;
    const box = canvas.getBoundingClientRect();
    const x = Math.floor(((event.clientX - box.left) / box.width) * size[0]);
    const y = Math.floor(((event.clientY - box.top) / box.height) * size[1]);
    if (x < 0 || y < 0 || x >= size[0] || y >= size[1]) return;
    const picture = current();
    const place = picture ? [x * picture.film[0] / size[0], y * picture.film[1] / size[1]] : [x, y];
    const count = shown.layer === "image" ? 3 : 1;
    const found = Array.from({ length: count }, (_, c) => VALUES[pixels[count * (y * size[0] + x) + c]]);
    const text = count === 3 ? found.map((v) => short(v)).join(", ") : `noise ${short(100 * found[0])} %`;
    $("pixel").textContent = `(${place.map(Math.floor).join(", ")}): ${text}`;
  }

  // What the server says

  function current() {
    if (!state || !state.pictures.length) return null;
    return state.pictures.find((picture) => picture.name === chosen) ?? state.pictures[0];
  }

  const PHASES = {
    rendering: "rendering", paused: "paused", stopping: "stopping after the running pass",
    finished: "finished", interrupted: "interrupted", following: "following", lost: "no connection",
  };
  const isEnd = (phase) => phase === "finished" || phase === "interrupted";

  function showPhase(phase) {
    $("phase").textContent = PHASES[phase] ?? phase;
    $("phase").className = `phase ${phase}`;
    const canAct = KEY !== "" && state && state.actions.length > 0;
    $("actions").hidden = !canAct;
    $("pause").textContent = phase === "paused" ? "Continue" : "Pause";
    $("pause").disabled = phase !== "rendering" && phase !== "paused";
    $("stop").disabled = phase !== "rendering" && phase !== "paused";
  }

  function showState() {
    const { figures, facts } = state;
    const picture = current();
    showPhase(state.phase);
    const title = facts.title ?? "Render";
    $("title").textContent = title;
    const share = isEnd(state.phase) && state.phase === "finished" ? 1
      : figures.done ?? (figures.goal_spp ? figures.spp / figures.goal_spp : null);
    document.title = `${share !== null ? `${Math.floor(100 * share)} % ` : ""}${title}`;
    $("done").hidden = share === null;
    if (share !== null) $("done").value = share;

    const rows = [];
    const spp = picture?.spp ?? figures.spp;
    if (spp) rows.push(["Samples", `${spp.toLocaleString("en")}${figures.goal_spp ? ` of ${figures.goal_spp.toLocaleString("en")}` : ""} per pixel`]);
    const error = picture?.error ?? null;
    if (error !== null) rows.push(["relMSE", `${picture.measured ? "" : "about "}${short(error)}`]);
    if (figures.seconds !== undefined) rows.push(["Time", duration(figures.seconds)]);
    if (figures.seconds_left !== undefined && !isEnd(state.phase)) rows.push(["Left", `about ${duration(figures.seconds_left)}`]);
    if (figures.samples_per_second) rows.push(["Speed", `${short(figures.samples_per_second / 1e6)} million samples/s`]);
    if (figures.doing) rows.push(["Now", figures.doing]);
    list($("figures"), rows);

    const others = Object.entries(facts).filter(([key]) => key !== "title");
    if (picture) {
      const scaled = picture.size[0] !== picture.film[0] ? `, shown with ${picture.size.join("×")}` : "";
      others.push(["Image", `${picture.film.join("×")} pixels${scaled}`]);
      if (picture.channels.length) others.push(["Channels", picture.channels.join(", ")]);
    }
    list($("facts"), others);

    $("chosen").hidden = !picture || !(picture.learned || picture.effects.length);
    $("learned").textContent = picture?.learned ?? "";
    list($("effects"), picture?.effects ?? []);

    $("bad").hidden = !picture?.bad;
    if (picture?.bad) $("bad").textContent = `${picture.bad.toLocaleString("en")} pixels are NaN or infinite. They are pink.`;

    const names = state.pictures.map((one) => one.name);
    $("choose").hidden = names.length < 2;
    const options = [...$("picture").options].map((option) => option.value);
    if (options.join("\n") !== names.join("\n")) {
      $("picture").replaceChildren(...names.map((name) => new Option(name, name)));
    }
    if (picture) $("picture").value = picture.name;

    const hasError = Boolean(picture?.has_error);
    document.querySelector("[data-layer=error]").disabled = !hasError;
    if (!hasError && layer === "error") layer = "image";
    for (const button of document.querySelectorAll("[data-layer]")) {
      button.setAttribute("aria-pressed", button.dataset.layer === layer);
    }
    for (const id of ["exposure-row", "auto", "reset"]) $(id).hidden = layer !== "image";
    $("scale").hidden = layer !== "error";
    chart(picture?.history ?? [], picture?.measured);
  }

  // The curve

  function chart(history, isMeasured) {
    const points = history.filter(([seconds, , error]) => seconds > 0 && error > 0);
    $("chart").hidden = points.length < 2;
    if (points.length < 2) return;
    $("chart-note").textContent = isMeasured ? "measured" : "estimated";
    const [left, right, top, bottom] = [52, 392, 8, 160];
    const range = (values) => {
      const [low, high] = [Math.min(...values), Math.max(...values)].map(Math.log10);
      return high - low < 0.1 ? [low - 0.1, high + 0.1] : [low, high];
    };
    const [x0, x1] = range(points.map((p) => p[0]));
    const [y0, y1] = range(points.map((p) => p[2]));
    const x = (v) => left + ((Math.log10(v) - x0) / (x1 - x0)) * (right - left);
    const y = (v) => bottom - ((Math.log10(v) - y0) / (y1 - y0)) * (bottom - top);
    const make = (name, attributes, text) => {
      const element = document.createElementNS("http://www.w3.org/2000/svg", name);
      for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
      if (text !== undefined) element.textContent = text;
      return element;
    };
    // Ticks at powers of ten, or at 1, 2 and 5 times them where few powers are in the range
    const ticks = (low, high) => {
      const found = [];
      const steps = high - low > 2.5 ? [1] : high - low > 0.7 ? [1, 2, 5] : [1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9];
      for (let power = Math.floor(low); power <= high; power++) {
        for (const step of steps) {
          const value = step * 10 ** power;
          if (Math.log10(value) >= low - 1e-9 && Math.log10(value) <= high + 1e-9) found.push(value);
        }
      }
      const every = Math.ceil(found.length / 5);
      return found.filter((_, index) => index % every === 0);
    };
    const parts = [];
    for (const value of ticks(y0, y1)) {
      parts.push(make("line", { class: "grid", x1: left, x2: right, y1: y(value), y2: y(value) }));
      parts.push(make("text", { x: left - 6, y: y(value) + 4, "text-anchor": "end" }, short(value, 2)));
    }
    for (const value of ticks(x0, x1)) {
      parts.push(make("line", { class: "grid", x1: x(value), x2: x(value), y1: top, y2: bottom }));
      parts.push(make("text", { x: x(value), y: bottom + 16, "text-anchor": "middle" }, duration(value).replace(".0 ", " ")));
    }
    parts.push(make("text", { x: left, y: bottom + 30 }, "relMSE, both axes logarithmic"));
    parts.push(make("polyline", { class: "curve", points: points.map((p) => `${x(p[0]).toFixed(1)},${y(p[2]).toFixed(1)}`).join(" ") }));
    const last = points[points.length - 1];
    parts.push(make("circle", { class: "dot", cx: x(last[0]), cy: y(last[2]), r: 3.5 }));
    document.querySelector("#chart svg").replaceChildren(...parts);
  }

  // Questions to the server

  const isCurrent = (picture) => picture === null || (shown.name === picture.name
    && shown.layer === layer && shown.number === picture.number);

  async function loadPixels() {
    const picture = current();
    if (isCurrent(picture)) return;
    const asked = { name: picture.name, layer };
    const answer = await fetch(`/${layer}?name=${encodeURIComponent(picture.name)}`);
    if (!answer.ok) return;
    const content = await answer.arrayBuffer();
    const channels = asked.layer === "image" ? 3 : 1;
    if (content.byteLength !== 2 * channels * picture.size[0] * picture.size[1]) return; // another size by now
    pixels = new Uint16Array(content);
    size = picture.size;
    shown = { ...asked, number: Number(answer.headers.get("X-Number")) };
    draw();
  }

  async function ask() {
    clearTimeout(timer);
    const number = state && isCurrent(current()) ? state.number : 0;
    const query = new URLSearchParams({ page: PAGE, number, phase: state?.phase ?? "" });
    let next = PERIOD;
    try {
      const answer = await fetch(`/state?${query}`);
      if (!answer.ok) throw new Error(answer.statusText);
      state = await answer.json();
      misses = 0;
      $("lost").hidden = true;
      showState();
      await loadPixels();
      if (isEnd(state.phase)) {
        // Tells the server, which waits for it, that this page shows the last image
        const last = new URLSearchParams({ page: PAGE, number: state.number, phase: state.phase });
        if (isCurrent(current())) {
          await fetch(`/state?${last}`);
          return;
        }
        next = 100;
      }
    } catch {
      misses += 1;
      if (misses >= PATIENCE) {
        showPhase("lost");
        $("lost").textContent = "The render no longer answers: its process has ended. This is the last image that arrived here.";
        $("lost").hidden = state === null;
      }
    }
    timer = setTimeout(ask, next);
  }

  async function act(name) {
    $("pause").disabled = $("stop").disabled = true;
    try {
      await fetch(`/${name}`, { method: "POST", headers: { "X-Mitsuba-Ext-Key": KEY } });
    } finally {
      ask();
    }
  }

  $("pause").addEventListener("click", () => act(state.phase === "paused" ? "resume" : "pause"));
  $("stop").addEventListener("click", () => act("stop"));
  $("exposure").addEventListener("input", showExposure);
  $("auto").addEventListener("click", autoExposure);
  $("reset").addEventListener("click", () => expose(0));
  $("zoom").addEventListener("change", fit);
  new ResizeObserver(fit).observe($("frame"));
  canvas.addEventListener("pointermove", readPixel);
  canvas.addEventListener("pointerleave", () => { $("pixel").textContent = "\u00a0"; });
  const choose = () => { showState(); loadPixels().catch(() => {}); };
  $("picture").addEventListener("change", () => { chosen = $("picture").value; choose(); });
  for (const button of document.querySelectorAll("[data-layer]")) {
    button.addEventListener("click", () => { layer = button.dataset.layer; choose(); });
  }
  const bar = $("scale-bar").getContext("2d");
  COLORS.forEach(([r, g, b], x) => {
    bar.fillStyle = `rgb(${r} ${g} ${b})`;
    bar.fillRect(x, 0, 1, 1);
  });
  document.addEventListener("visibilitychange", () => { if (!document.hidden && state && !isEnd(state.phase)) ask(); });
  ask();
})();
