// Draws the interactive parts of a report from the JSON on the page. No library, no network.
"use strict";
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const GAP = { left: 58, right: 12, top: 12, bottom: 42 };

  // ---------------------------------------------------------------- helpers

  // Make an element: attributes, then children (text or elements).
  function make(name, attributes = {}, ...children) {
    const svg = ["svg", "g", "rect", "path", "text", "line", "circle", "defs", "pattern", "clipPath", "title"];
    const element = svg.includes(name) ? document.createElementNS(SVG, name) : document.createElement(name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.append(...children);
    return element;
  }

  // A number with four digits, as in the tables.
  function format(value) {
    if (value === null || value === undefined) return "-";
    if (typeof value === "boolean") return value ? "yes" : "no";
    if (typeof value === "string") return value;
    const size = Math.abs(value);
    if (size !== 0 && (size >= 1e5 || size < 1e-4)) return value.toExponential(3).replace(/\.?0*e\+?/, "e");
    return String(Number(value.toPrecision(4)));
  }

  // The same for ticks, where room is short.
  const short = (value) => (Math.abs(value) >= 1e4 ? value.toExponential().replace("+", "") : format(value));

  function change(value, base) {
    if (typeof value !== "number" || typeof base !== "number" || base === 0) return "";
    const percent = 100 * (value / base - 1);
    return (percent < 0 ? "" : "+") + percent.toFixed(Math.abs(percent) < 100 ? 1 : 0);
  }

  const named = (text) => (text.unit ? `${text.label} [${text.unit}]` : text.label);

  function unpacked(text) {
    return new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  }

  // A scale from values to pixels; its ticks are round numbers, or powers of ten where it is logarithmic.
  function scale(low, high, from, to, log = false) {
    const f = log ? Math.log10 : (v) => v;
    const [a, b] = [f(low), f(high)];
    const at = (v) => from + ((f(v) - a) / (b - a || 1)) * (to - from);
    const room = Math.abs(to - from);
    let ticks = [];
    if (log && b - a >= 1) {
      for (let e = Math.ceil(a - 1e-9); e <= b + 1e-9; e++) ticks.push(10 ** e);
    } else {
      const raw = (high - low) / Math.max(2, room / (to < from ? 45 : 70));
      const power = 10 ** Math.floor(Math.log10(raw));
      const step = power * [1, 2, 5, 10].find((m) => m * power >= raw * 0.999);
      for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) ticks.push(Number(v.toPrecision(9)));
    }
    const every = Math.ceil(ticks.length / (room / 40));
    return { at, ticks: ticks.filter((_, i) => i % every === 0) };
  }

  // On which line each disturbance is named: its own where the words of another are in its way. `pixel` is in s.
  function labelLines(windows, pixel) {
    const placed = [];
    for (const [from, to, label] of windows) {
      const [middle, half] = [(from + to) / 2, 0.5 * pixel * 6.5 * (label.length + 1)];
      const busy = placed.filter((each) => Math.abs(each.middle - middle) < half + each.half).map((each) => each.line);
      placed.push({ line: windows.findIndex((_, line) => !busy.includes(line)), middle, half });
    }
    return placed.map((each) => each.line);
  }

  // An empty drawing as wide as its place.
  function canvas(place, height, label, interactive = false) {
    const width = Math.max(260, Math.round(place.clientWidth));
    const svg = make("svg", { viewBox: `0 0 ${width} ${height}`, role: interactive ? "application" : "img", "aria-label": label });
    place.replaceChildren(svg);
    return { svg, width, height };
  }

  function axes(svg, box, x, y, xText, yText, lines = true) {
    for (const v of x.ticks) {
      if (lines) svg.append(make("line", { x1: x.at(v), x2: x.at(v), y1: box.top, y2: box.bottom, class: "grid" }));
      svg.append(make("text", { x: x.at(v), y: box.bottom + 15, "text-anchor": "middle", class: "soft" }, short(v)));
    }
    for (const v of y.ticks) {
      if (lines) svg.append(make("line", { x1: box.left, x2: box.right, y1: y.at(v), y2: y.at(v), class: "grid" }));
      svg.append(make("text", { x: box.left - 6, y: y.at(v) + 4, "text-anchor": "end", class: "soft" }, short(v)));
    }
    svg.append(make("path", { d: `M${box.left} ${box.top}V${box.bottom}H${box.right}`, class: "axis" }));
    svg.append(make("text", { x: (box.left + box.right) / 2, y: box.bottom + 34, "text-anchor": "middle" }, xText));
    if (yText) svg.append(make("text", { transform: `translate(13 ${(box.top + box.bottom) / 2}) rotate(-90)`, "text-anchor": "middle" }, yText));
  }

  const MARKS = [
    "M0-9L2.1-2.9L8.6-2.8L3.4 1.1L5.3 7.3L0 3.6L-5.3 7.3L-3.4 1.1L-8.6-2.8L-2.1-2.9Z", // star
    "M5.5 0A5.5 5.5 0 1 1-5.5 0A5.5 5.5 0 1 1 5.5 0Z", // circle
    "M0-6.5L6.5 0L0 6.5L-6.5 0Z", // diamond
    "M0-6.5L6 5L-6 5Z", // triangle
    "M-5-5H5V5H-5Z", // square
  ];

  function mark(number, x, y, label) {
    return make("path", { d: MARKS[number % MARKS.length], transform: `translate(${x} ${y})`, class: "mark" }, make("title", {}, label));
  }

  function legend(entries, limited = false) {
    const row = make("div", { class: "controls hint" });
    for (const [number, text] of entries) {
      const icon = make("svg", { width: 20, height: 20, viewBox: "-10 -10 20 20", "aria-hidden": "true" }, make("path", { d: MARKS[number % MARKS.length], class: "mark" }));
      row.append(make("label", {}, icon, text));
    }
    if (limited) row.append(make("label", {}, make("span", { class: "swatch limit-swatch" }), "limit of stability"));
    return row;
  }

  function selector(text, options, value, changed) {
    const select = make("select");
    for (const [key, label] of options) select.append(make("option", { value: key }, label));
    select.value = value;
    select.addEventListener("change", () => changed(select.value));
    return make("label", {}, text, select);
  }

  // Paper shows what is folded, too.
  addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((part) => (part.open = true)));

  // ---------------------------------------------------------------- one interactive part

  class Explorer {
    constructor(place, data) {
      this.data = data;
      this.points = data.points;
      this.base = data.walks.find((walk) => walk.name === data.baseline);
      this.walks = data.walks.map((walk, number) => ({ ...walk, number, lines: mapped(walk.lines, unpacked) }));
      this.shown = new Set(data.walks.filter((walk) => walk.shown).map((walk) => walk.name));
      this.drawings = [];
      if (this.points) {
        this.texts = { ...data.metrics, ...this.points.texts };
        this.histories = mapped(this.points.histories, unpacked);
        // no cell is chosen where the page opens on a walk of its own
        this.cell = this.pointed = data.opens_on ? null : this.points.begin;
        this.metric = "objective" in this.points.scales ? "objective" : "force_variation" in this.points.scales ? "force_variation" : Object.keys(this.points.scales)[0];
        this.trade = { x: this.points.trade ? this.points.trade[0] : "base_deviation", y: this.points.trade ? this.points.trade[1] : "force_variation" };
        this.buildPoints(place);
      }
      this.buildWalks(place);
      this.draw();
      let width = place.clientWidth;
      new ResizeObserver(() => {
        if (place.clientWidth === width) return;
        width = place.clientWidth;
        this.draw();
      }).observe(place);
    }

    draw() {
      for (const drawing of this.drawings) drawing();
    }

    // Cells: map, readout, trade-off.
    buildPoints(place) {
      const { points } = this;
      const readout = make("div", { class: "readout", "aria-live": "polite" });
      this.readout = readout;
      const mappable = Object.keys(points.values).filter((name) => name in points.scales);
      const options = mappable.map((name) => [name, named(this.texts[name])]);
      const left = make("div");
      if (points.axes) {
        const map = make("div", { class: "draw map" });
        left.append(
          make("div", { class: "controls screen" }, selector("Map of", options, this.metric, (name) => ((this.metric = name), this.drawMap(map), this.mapTitle()))),
          (this.heading = make("p", { class: "title" })),
          map,
          (this.between = make("p", { class: "hint screen between", "aria-live": "off" })),
          legend(points.marks.map((m) => [this.symbol(m.name), m.name]), points.limit.length > 0),
          make("p", { class: "hint screen" }, "Brighter is better, and colours end where the bar does; walks hatched by lines lost a gripper, those hatched crosswise diverged with all of them. Point at a cell for its numbers, click it for its walk over time; arrow keys move, Enter chooses."),
        );
        this.drawings.push(() => this.drawMap(map));
        this.mapTitle();
      }
      const front = make("div", { class: "draw front" });
      const trade = make("div", {}, make("h3", {}, "Trade-off"));
      const redraw = () => this.drawFront(front);
      if (!points.trade) {
        trade.append(make("div", { class: "controls screen" },
          selector("Across", options, this.trade.x, (name) => ((this.trade.x = name), redraw())),
          selector("up", options, this.trade.y, (name) => ((this.trade.y = name), redraw()))));
      }
      trade.append(front, legend(this.data.walks.map((walk) => [this.symbol(walk.name), walk.name])),
        make("p", { class: "hint" }, "Each dot is a walk that held; the line joins those that none beats in both."));
      this.drawings.push(redraw);
      const right = make("div", {}, make("h3", {}, this.data.opens_on ? "Numbers" : points.axes ? "Cell" : "Point"), readout);
      if (points.axes) right.append(trade);
      place.append(make("div", { class: "columns" }, points.axes ? left : trade, right));
      if (points.left_out) place.append(make("p", { class: "hint" }, `This page shows ${points.count} of ${points.count + points.left_out} walks, evenly chosen; the data file holds all.`));
      this.say(this.pointed);
    }

    // Which mark stands for a walk: the same on the map and on the trade-off.
    symbol(name) {
      return [...new Set([...this.points.marks, ...this.data.walks].map((each) => each.name))].indexOf(name);
    }

    mapTitle() {
      this.heading.textContent = named(this.texts[this.metric]);
    }

    // All numbers of one cell, or those of the walk that the page opens on where there is none.
    say(cell) {
      this.pointed = cell;
      const { points, base } = this;
      const walk = cell === null && this.walks.find((each) => each.name === this.data.opens_on);
      const gains = Object.entries(points.gains).map(([name, values]) => `${name} ${format(values[cell])}`).join(", ");
      const table = make("table", { "data-cell": cell ?? "" }, make("caption", {}, walk ? walk.name : gains));
      table.append(make("thead", {}, make("tr", {}, ...["", "value", base.name, `vs ${base.name} %`].map((t) => make("th", { scope: "col" }, t)))));
      const body = make("tbody");
      for (const [name, values] of Object.entries(points.values)) {
        if (walk && !(name in walk.metrics)) continue;
        const text = this.texts[name];
        const value = walk ? walk.metrics[name] : values[cell];
        const reference = base.metrics[name];
        const compares = !base.failed && !(walk || { failed: points.failed[cell] }).failed;
        body.append(make("tr", { "data-metric": name },
          make("th", { scope: "row", class: "word" }, named(text)), make("td", {}, format(value)),
          make("td", {}, name in base.metrics ? format(reference) : ""), make("td", {}, compares ? change(value, reference) : "")));
      }
      table.append(body);
      const { failed } = walk || { failed: points.failed[cell] };
      this.readout.replaceChildren(make("div", { class: "wide" }, table), make("p", failed ? { class: "failed" } : {}, failed ? failed.text : "all grippers held"));
      if (this.outline) this.outline();
    }

    // The map's metric at a place in cells from the first centre, in words: bilinear in the logarithms of the gains.
    interpolated(i, j) {
      const { points, metric } = this;
      const [xs, ys] = points.axes.map((axis) => axis.values);
      if (xs.length < 2 || ys.length < 2 || i < 0 || j < 0 || i > xs.length - 1 || j > ys.length - 1) return "";
      const [a, b] = [Math.min(Math.floor(i), xs.length - 2), Math.min(Math.floor(j), ys.length - 2)];
      const [u, v] = [i - a, j - b];
      const at = [[xs, a, u], [ys, b, v]].map(([axis, k, share], n) => `${points.axes[n].name} ${format(axis[k] ** (1 - share) * axis[k + 1] ** share)}`);
      const cells = [0, 1, ys.length, ys.length + 1].map((step) => a * ys.length + b + step);
      const values = cells.map((cell) => points.values[metric][cell]);
      if (cells.some((cell) => points.failed[cell]) || values.some((value) => typeof value !== "number")) {
        return `Between cells, at ${at.join(", ")}: not interpolated, as a walk beside it failed.`;
      }
      const log = points.scales[metric].log && Math.min(...values) > 0;
      const shares = [(1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v];
      const sum = shares.reduce((total, share, n) => total + share * (log ? Math.log(values[n]) : values[n]), 0);
      return `Between cells, interpolated: ${named(this.texts[metric])} ${format(log ? Math.exp(sum) : sum)} at ${at.join(", ")}.`;
    }

    choose(cell) {
      this.cell = cell;
      this.say(cell);
      this.drawCharts();
    }

    color(metric, value) {
      const { low, high, log } = this.points.scales[metric];
      const f = log ? Math.log : (v) => v;
      let share = value <= 0 && log ? 0 : (f(value) - f(low)) / (f(high) - f(low));
      share = Math.min(1, Math.max(0, share));
      if (!this.texts[metric].larger_is_better) share = 1 - share;
      const count = this.points.colors.length / 6;
      const index = Math.min(count - 1, Math.floor(share * count));
      return "#" + this.points.colors.slice(6 * index, 6 * index + 6);
    }

    drawMap(place) {
      const { points, metric } = this;
      const [xs, ys] = points.axes.map((axis) => axis.values);
      const wide = place.clientWidth;
      // it ends with the first screen, below the sentence and the five rows
      const tall = Math.max(280, Math.min(620, 0.95 * wide, innerHeight - 510));
      const { svg, width, height } = canvas(place, Math.round(tall), `Map of ${this.texts[metric].label} over ${this.points.axes[0].name} and ${this.points.axes[1].name}`, true);
      svg.setAttribute("tabindex", "0");
      const box = { left: GAP.left, right: width - 74, top: GAP.top, bottom: height - GAP.bottom };
      const w = (box.right - box.left) / xs.length;
      const h = (box.bottom - box.top) / ys.length;
      const hatches = { torn: ["M3 0V6"], diverged: ["M3 0V6", "M0 3H6"] };
      const prefix = `hatch-${Math.random().toString(36).slice(2)}`;
      svg.append(make("defs", {}, ...Object.entries(hatches).map(([kind, ways]) => make("pattern", { id: `${prefix}-${kind}`, width: 6, height: 6, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" },
        ...ways.map((d) => make("path", { d, stroke: "#fff", "stroke-width": 2.4 })), ...ways.map((d) => make("path", { d, stroke: "#000", "stroke-width": 1 }))))));
      const left = (cell) => box.left + w * Math.floor(cell / ys.length);
      const top = (cell) => box.bottom - h * ((cell % ys.length) + 1);
      const values = points.values[metric];
      const known = new Set(values.filter((v) => typeof v === "number"));
      const plain = known.size === 1 ? "#ededed" : null; // a colour would tell nothing
      for (let cell = 0; cell < points.count; cell++) {
        const at = { x: left(cell), y: top(cell), width: w + 0.3, height: h + 0.3 };
        const fill = typeof values[cell] === "number" ? plain || this.color(metric, values[cell]) : "#bdbdbd";
        svg.append(make("rect", { ...at, fill, "data-cell": cell }));
        if (points.failed[cell]) svg.append(make("rect", { ...at, fill: `url(#${prefix}-${points.failed[cell].at === null ? "diverged" : "torn"})`, "pointer-events": "none" }));
      }
      // gains lie on a logarithmic scale, cells are equally wide: between neighbours it is logarithmic too
      const along = (axis, from, step) => {
        const n = axis.length;
        const logs = axis.map(Math.log);
        return (v) => {
          let i = logs.findIndex((l) => l >= Math.log(v)) - 1;
          if (i === -2) i = n - 2;
          i = Math.min(n - 2, Math.max(0, i));
          return n < 2 ? from + step / 2 : from + step * (0.5 + i + (Math.log(v) - logs[i]) / (logs[i + 1] - logs[i]));
        };
      };
      const powers = (axis) => {
        const found = [];
        for (let e = Math.ceil(Math.log10(axis[0]) - 0.1); e <= Math.log10(axis.at(-1)) + 0.1; e++) found.push(10 ** e);
        return found.length > 1 ? found : [axis[0], axis.at(-1)];
      };
      const x = { at: along(xs, box.left, w), ticks: powers(xs) };
      const y = { at: along(ys, box.bottom, -h), ticks: powers(ys) };
      axes(svg, box, x, y, ...points.axes.map((axis) => `${axis.label} [${axis.unit}]`), false);
      const lines = points.limit.map((line) => "M" + line.map(([a, b]) => `${x.at(a).toFixed(1)} ${y.at(b).toFixed(1)}`).join("L"));
      if (lines.length) svg.append(make("path", { d: lines.join(""), class: "limit" }, make("title", {}, "limit of stability")));
      points.marks.forEach((m) => {
        const [mx, my] = [x.at(m.at[0]), y.at(m.at[1])];
        const inside = mx >= box.left - w && mx <= box.right + w && my >= box.top - h && my <= box.bottom + h;
        if (inside) svg.append(mark(this.symbol(m.name), mx, my, m.name));
      });
      if (plain) svg.append(make("text", { x: (box.left + box.right) / 2, y: (box.top + box.bottom) / 2, "text-anchor": "middle", class: "constant" }, `all cells: ${format([...known][0])}`));
      else this.drawBar(svg, { ...box, left: box.right + 10, right: box.right + 22 });
      const frames = ["halo", "pointed", "chosen"].map((name) => make("rect", { class: name, width: w, height: h }));
      svg.append(...frames);
      this.outline = () => {
        frames.forEach((frame, i) => {
          const cell = i < 2 ? this.pointed : this.cell;
          frame.setAttribute("visibility", cell === null ? "hidden" : "visible");
          frame.setAttribute("x", left(cell));
          frame.setAttribute("y", top(cell));
        });
      };
      this.outline();
      const of = (event) => event.target.dataset && event.target.dataset.cell;
      svg.addEventListener("pointerover", (event) => of(event) !== undefined && this.say(Number(of(event))));
      svg.addEventListener("pointermove", (event) => {
        const drawn = svg.getBoundingClientRect();
        const [px, py] = [((event.clientX - drawn.left) * width) / drawn.width, ((event.clientY - drawn.top) * height) / drawn.height];
        this.between.textContent = this.interpolated((px - box.left) / w - 0.5, (box.bottom - py) / h - 0.5);
      });
      svg.addEventListener("pointerleave", () => (this.between.textContent = ""));
      svg.addEventListener("click", (event) => of(event) !== undefined && this.choose(Number(of(event))));
      svg.addEventListener("keydown", (event) => {
        const from = this.pointed ?? points.begin;
        const [i, j] = [Math.floor(from / ys.length), from % ys.length];
        const to = { ArrowLeft: [i - 1, j], ArrowRight: [i + 1, j], ArrowUp: [i, j + 1], ArrowDown: [i, j - 1], Enter: [i, j], " ": [i, j] }[event.key];
        if (!to) return;
        event.preventDefault();
        const [a, b] = [Math.min(xs.length - 1, Math.max(0, to[0])), Math.min(ys.length - 1, Math.max(0, to[1]))];
        if (event.key === "Enter" || event.key === " ") this.choose(from);
        else this.say(a * ys.length + b);
      });
    }

    // The colour bar, with a line where the baseline lies.
    drawBar(svg, box) {
      const { low, high, log } = this.points.scales[this.metric];
      const y = scale(low, high, box.bottom, box.top, log);
      const steps = 64;
      for (let i = 0; i < steps; i++) {
        const share = (i + 0.5) / steps;
        const value = log ? low * (high / low) ** share : low + share * (high - low);
        const step = (box.bottom - box.top) / steps;
        svg.append(make("rect", { x: box.left, y: box.bottom - step * (i + 1), width: box.right - box.left, height: step + 0.4, fill: this.color(this.metric, value) }));
      }
      const base = this.metric === "objective" ? 1 : this.base.metrics[this.metric];
      const there = typeof base === "number" && base >= low && base <= high;
      for (const v of y.ticks) {
        if (there && Math.abs(y.at(v) - y.at(base)) < 12) continue;
        svg.append(make("text", { x: box.right + 4, y: y.at(v) + 4, class: "soft" }, short(v)));
      }
      if (there) {
        svg.append(make("path", { d: `M${box.left - 4} ${y.at(base)}H${box.right + 4}`, stroke: "var(--red)", "stroke-width": 2.5 }));
        svg.append(make("text", { x: box.right + 6, y: y.at(base) + 4, class: "base" }, this.base.name));
      }
    }

    // Walks that held, two metrics against each other, and those that none beats in both.
    drawFront(place) {
      const { points, trade } = this;
      const sign = (name) => (this.texts[name].larger_is_better ? -1 : 1);
      const [vx, vy] = [points.values[trade.x], points.values[trade.y]];
      const held = [...vx.keys()].filter((c) => !points.failed[c] && typeof vx[c] === "number" && typeof vy[c] === "number");
      held.sort((a, b) => sign(trade.x) * (vx[a] - vx[b]) || sign(trade.y) * (vy[a] - vy[b]));
      let best = Infinity;
      const front = held.filter((c) => sign(trade.y) * vy[c] < best && ((best = sign(trade.y) * vy[c]), true));
      const named_ = this.data.walks.filter((walk) => typeof walk.metrics[trade.x] === "number" && typeof walk.metrics[trade.y] === "number");
      const { svg, width, height } = canvas(place, 300, `${this.texts[trade.y].label} against ${this.texts[trade.x].label}`);
      svg.dataset.front = front.join(" ");
      const box = { left: GAP.left + 6, right: width - GAP.right, top: GAP.top, bottom: height - GAP.bottom };
      const ends = (values, others) => {
        const all = [...held.map((c) => values[c]), ...others].sort((a, b) => a - b);
        if (!all.length) return [0, 1, false];
        const [low, high] = [all[0], all[Math.ceil(0.9 * (all.length - 1))]];
        const top = Math.max(high, ...others, ...front.map((c) => values[c]));
        const log = low > 0 && top / low > 20;
        const room = log ? (top / low) ** 0.05 : 0.06 * (top - low || Math.abs(top) || 1);
        return log ? [low / room, top * room, true] : [low - room, top + room, false];
      };
      const [x0, x1, xLog] = ends(vx, named_.map((walk) => walk.metrics[trade.x]));
      const [y0, y1, yLog] = ends(vy, named_.map((walk) => walk.metrics[trade.y]));
      const [x, y] = [scale(x0, x1, box.left, box.right, xLog), scale(y0, y1, box.bottom, box.top, yLog)];
      axes(svg, box, x, y, named(this.texts[trade.x]), named(this.texts[trade.y]));
      const inside = (c) => vx[c] >= x0 && vx[c] <= x1 && vy[c] >= y0 && vy[c] <= y1;
      svg.append(make("path", { d: front.map((c, i) => `${i ? "L" : "M"}${x.at(vx[c])} ${y.at(vy[c])}`).join(""), fill: "none", stroke: "var(--s1)", "stroke-width": 2 }));
      for (const c of held.filter(inside)) {
        const on = front.includes(c);
        svg.append(make("circle", { cx: x.at(vx[c]), cy: y.at(vy[c]), r: on ? 5 : 4, fill: on ? "var(--s1)" : "var(--s0)", "data-cell": c }));
      }
      for (const walk of named_) svg.append(mark(this.symbol(walk.name), x.at(walk.metrics[trade.x]), y.at(walk.metrics[trade.y]), walk.name));
      const of = (event) => event.target.dataset && event.target.dataset.cell;
      svg.addEventListener("pointerover", (event) => of(event) !== undefined && this.say(Number(of(event))));
      svg.addEventListener("click", (event) => of(event) !== undefined && this.choose(Number(of(event))));
    }

    // Walks over time.
    buildWalks(place) {
      const keys = make("div", { class: "controls series" });
      this.charts = this.data.lines.map((line) => ({ line, place: make("div", { class: "draw chart", "data-line": line.name }) }));
      this.caption = make("p", { class: "hint" });
      const instant = make("p", { class: "hint screen instant" });
      for (const walk of this.walks) {
        const box = make("input", { type: "checkbox" });
        box.checked = this.shown.has(walk.name);
        box.addEventListener("change", () => {
          if (box.checked) this.shown.add(walk.name);
          else this.shown.delete(walk.name);
          this.drawCharts();
        });
        const swatch = make("span", { class: "swatch", style: `border-color: ${this.tint(walk)}` });
        keys.append(make("label", {}, box, swatch, walk.name));
      }
      this.chosenKey = make("label", { class: "chosen-key" });
      if (this.points) keys.append(this.chosenKey);
      this.instant = instant;
      place.append(make("h3", { class: "walks" }, this.points && !this.data.opens_on ? "The chosen cell over time" : "Over time"), keys,
        make("div", { class: "charts" }, ...this.charts.map((chart) => chart.place)), instant, this.caption);
      this.drawings.push(() => this.drawCharts());
    }

    // grey for the baseline, the first colour for the chosen cell where there are cells
    tint(walk) {
      if (walk.name === this.data.baseline) return "var(--s0)";
      const others = this.walks.filter((w) => w.name !== this.data.baseline);
      return `var(--s${1 + ((others.indexOf(walk) + (this.points ? 1 : 0)) % 5)})`;
    }

    // The cell nearest to the chosen one that has a history.
    storedCell() {
      const { points, cell } = this;
      if (cell === null || !points.stored.length) return null;
      const rows = points.axes ? points.axes[1].values.length : 1;
      const far = (c) => Math.hypot(Math.floor(c / rows) - Math.floor(cell / rows), (c % rows) - (cell % rows));
      return points.stored.reduce((a, b) => (far(b) < far(a) ? b : a));
    }

    series() {
      const found = this.walks.filter((walk) => this.shown.has(walk.name)).map((walk) => ({ name: walk.name, tint: this.tint(walk), broad: walk.name === this.data.baseline, failed: walk.failed, lines: walk.lines }));
      found.sort((a, b) => b.broad - a.broad);
      const cell = this.points ? this.storedCell() : null;
      if (cell !== null) {
        const size = 2 * this.data.time.count;
        const start = size * this.points.stored.indexOf(cell);
        found.push({ name: "cell", tint: "var(--s1)", failed: this.points.failed[cell], lines: mapped(this.histories, (values) => values.subarray(start, start + size)) });
        const gains = Object.entries(this.points.gains).map(([name, values]) => `${name} ${format(values[cell])}`).join(", ");
        const nearest = cell === this.cell ? "" : " (the nearest with a history on this page)";
        this.chosenKey.replaceChildren(make("span", { class: "swatch", style: "border-color: var(--s1)" }), gains + nearest);
        this.chosenKey.dataset.cell = cell;
      }
      return found;
    }

    drawCharts() {
      const series = this.series();
      const failures = series.filter((s) => s.failed).map((s) => `${s.name}: ${s.failed.text}`);
      this.caption.textContent = `Each line runs from the least to the largest value in every ${format(1000 * this.data.time.stretch)} ms.` +
        (failures.length ? ` Red marks: ${failures.join("; ")}.` : "");
      for (const chart of this.charts) this.drawChart(chart.place, chart.line, series);
    }

    drawChart(place, line, series) {
      const { count, stretch, end } = this.data.time;
      const lines_ = labelLines(this.data.windows, end / Math.max(260, place.clientWidth));
      const extra = 12 * Math.max(0, ...lines_);
      const { svg, width, height } = canvas(place, 250 + extra, `${line.label} over time: ${series.map((s) => s.name).join(", ")}`);
      const box = { left: GAP.left - 4, right: width - GAP.right, top: 40 + extra, bottom: height - GAP.bottom };
      const drawn = series.map((s) => {
        const values = s.lines[line.name];
        let whole = 0; // stretches before the state stopped being finite
        while (whole < count && Number.isFinite(values[count + whole])) whole++;
        const before = s.failed ? (s.failed.at === null ? Math.floor(whole / 2) : Math.floor(s.failed.at / stretch) + 1) : whole;
        const peak = (n) => values.subarray(count, count + n).reduce((a, b) => Math.max(a, b), 0);
        // after a failure a walk may be a thousand times larger: the axis reaches three times what was before
        return { ...s, values, whole, top: Math.min(peak(whole), s.failed ? 3 * peak(before) : Infinity) };
      });
      const limit = line.name === "foot_force_history" ? this.data.holding_limit : null;
      let top = Math.max(...drawn.map((s) => s.top), 1e-12) * line.factor;
      if (limit !== null && limit < 2 * top) top = Math.max(top, 1.05 * limit);
      const x = scale(0, end, box.left, box.right);
      const y = scale(0, 1.05 * top, box.bottom, box.top);
      this.data.windows.forEach(([from, to, label], number) => {
        const tone = label.startsWith("cargo") ? "cargo" : "push";
        svg.append(make("rect", { x: x.at(from), y: box.top, width: x.at(to) - x.at(from), height: box.bottom - box.top, fill: `var(--${tone})` }, make("title", {}, label)));
        const middle = Math.min(box.right - 30, Math.max(box.left + 30, x.at((from + to) / 2)));
        svg.append(make("text", { x: middle, y: box.top - 4 - 12 * lines_[number], "text-anchor": "middle", class: "small soft" }, label));
      });
      svg.append(make("text", { x: 0, y: 14, class: "title" }, `${line.label} [${line.unit}]`));
      axes(svg, box, x, y, "time [s]", "");
      for (const t of this.data.grips) svg.append(make("line", { x1: x.at(t), x2: x.at(t), y1: box.top, y2: box.bottom, stroke: "var(--soft)", "stroke-width": 0.6, "stroke-dasharray": "4 3" }));
      if (limit !== null && limit <= 1.05 * top) {
        svg.append(make("path", { d: `M${box.left} ${y.at(limit)}H${box.right}`, stroke: "var(--ink)", "stroke-dasharray": "2 3" }));
        svg.append(make("text", { x: box.right - 2, y: y.at(limit) - 4, "text-anchor": "end", class: "small" }, "holding limit"));
      }
      const clip = `clip-${Math.random().toString(36).slice(2)}`;
      svg.append(make("clipPath", { id: clip }, make("rect", { x: box.left, y: box.top, width: box.right - box.left, height: box.bottom - box.top })));
      const lines = make("g", { "clip-path": `url(#${clip})` });
      for (const s of drawn) {
        // up along the largest values, back along the least
        const point = (i, extreme) => `${x.at(Math.min(end, (i + 0.5) * stretch)).toFixed(1)} ${y.at(Math.min(s.values[extreme * count + i] * line.factor, 10 * top)).toFixed(1)}`;
        const there = Array.from({ length: s.whole }, (_, i) => point(i, 1));
        const back = Array.from({ length: s.whole }, (_, i) => point(s.whole - 1 - i, 0));
        if (s.whole) lines.append(make("path", { d: `M${[...there, ...back].join("L")}Z`, fill: s.tint, stroke: s.tint, "stroke-width": s.broad ? 2.2 : 1, "stroke-linejoin": "round", "data-series": s.name }));
        const failedAt = s.failed && (s.failed.at === null ? s.whole * stretch : s.failed.at);
        if (s.failed) lines.append(make("path", { d: `M${x.at(failedAt)} ${box.top}V${box.bottom}`, stroke: "var(--red)", "stroke-width": 1.5 }, make("title", {}, `${s.name}: ${s.failed.text}`)));
      }
      svg.append(lines);
      svg.addEventListener("pointermove", (event) => {
        const place_ = svg.getBoundingClientRect();
        const at = ((event.clientX - place_.left) / place_.width) * width;
        const i = Math.floor(((at - box.left) / (box.right - box.left)) * (end / stretch));
        if (i < 0 || i >= count) return;
        this.instant.textContent = `${line.label} from ${format(i * stretch)} s: ` + drawn.map((s) => `${s.name} ${format(s.values[i] * line.factor)} to ${format(s.values[count + i] * line.factor)} ${line.unit}`).join("; ");
      });
    }
  }

  const mapped = (object, f) => Object.fromEntries(Object.entries(object).map(([key, value]) => [key, f(value)]));

  const explorers = JSON.parse(document.getElementById("data").textContent).map((data, number) => new Explorer(document.querySelector(`[data-explorer="${number}"]`), data));
  // paper has no pointer to open things with
  window.addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((part) => (part.open = true)));
  window.report = explorers; // for the console, and for tests
})();
