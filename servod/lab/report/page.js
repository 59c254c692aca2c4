// Draws the figures of a report as SVG at the size they are seen in, zooms them together, and prints them whole.
//
// The page holds every row (see page.py); what is in view is drawn from those: all rows where they are few, else
// the lowest and the highest of each bin, so that a fast sine is a band from afar and a sine from near.
// Text is HTML or SVG text of 12 px that no scaling touches; colours are variables of page.css.
"use strict";

const MOST_IN_VIEW = 4000, PRINT_PX = 690, LEAST_COLUMN_PX = 210, ROW_PX = 230, PRINT_ROW_PX = 165, HOVERED = 6;
const LEAST_LEFT_PX = 50, RIGHT_PX = 12, GAP_PX = 6;
const BESIDE_PX = 28, NAME_PX = 17; // above and below a panel; what a name of its scale needs
const TICK_FONT = "12px system-ui, sans-serif"; // that of .panel text in page.css

// --- Rows ---

function unpacked(bytes, kind) {
  return kind === "f8" ? new Float64Array(bytes.buffer) : new Float32Array(bytes.buffer);
}

async function loaded(array) {
  if (array.z === undefined) return Float64Array.from({ length: array.n }, (_, k) => array.from + k * array.step);
  const packed = Uint8Array.from(atob(array.z), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const rows = new Uint8Array(bytes.length), size = array.kind === "f8" ? 8 : 4, n = bytes.length / size;
  for (let part = 0; part < size; part++) for (let k = 0; k < n; k++) rows[k * size + part] = bytes[part * n + k];
  return unpacked(rows, array.kind);
}

function ascends(x) {
  for (let k = 1; k < x.length; k++) if (!(x[k] >= x[k - 1])) return false;
  return true;
}

function place(x, at) {
  let a = 0, b = x.length;
  while (a < b) { const m = (a + b) >> 1; if (x[m] < at) a = m + 1; else b = m; }
  return a;
}

// The rows between `from` and `to` with a neighbour on each side; of more than `most` the first, the last, and of equal
// bins the lowest, the highest, and one that is no number.
function view(x, y, from, to, most) {
  const a = Math.max(place(x, from) - 1, 0), b = Math.min(place(x, to) + 1, x.length);
  if (b - a <= most) return [Array.from(x.subarray(a, b)), Array.from(y.subarray(a, b))];
  const bins = Math.floor((most - 2) / 3), xs = [x[a]], ys = [y[a]];
  for (let k = 0; k < bins; k++) {
    const p = a + Math.floor((k * (b - a)) / bins), q = a + Math.floor(((k + 1) * (b - a)) / bins);
    let low = -1, high = -1, hole = -1;
    for (let i = p; i < q; i++) {
      if (Number.isNaN(y[i])) { hole = i; continue; }
      if (low < 0 || y[i] < y[low]) low = i;
      if (high < 0 || y[i] > y[high]) high = i;
    }
    const kept = new Set([low, high, hole].filter((i) => i > a && i < b - 1).sort((i, j) => i - j));
    for (const i of kept) { xs.push(x[i]); ys.push(y[i]); }
  }
  xs.push(x[b - 1]);
  ys.push(y[b - 1]);
  return [xs, ys];
}

// --- Scales; ranges of a logarithmic one are those of the logarithm ---

const log10 = (v) => (v > 0 ? Math.log10(v) : NaN);
const raised = (n) => String(n).replace(/[-\d]/g, (c) => (c === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[c]));

function extent(lists) {
  let low = Infinity, high = -Infinity;
  for (const list of lists) for (const v of list) if (Number.isFinite(v)) { if (v < low) low = v; if (v > high) high = v; }
  if (low > high) return [0, 1];
  return low === high ? [low - (Math.abs(low) || 1) * 0.5, high + (Math.abs(high) || 1) * 0.5] : [low, high];
}

function linearTicks(from, to, most) {
  const raw = (to - from) / Math.max(most, 1), size = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((k) => k * size).find((s) => s >= raw * (1 - 1e-9)), at = [];
  for (let k = Math.ceil(from / step - 1e-6); k * step <= to + 1e-6 * step; k++) at.push(k * step);
  return [at, step];
}

// Places and words of the ticks, and a factor of ten that stands beside the label instead of in every word.
function ticks(scale, from, to, most) {
  if (scale.names) {
    return { at: scale.names.map((_, k) => k).filter((k) => k >= from && k <= to), words: (k) => scale.names[k], factor: "" };
  }
  if (scale.log) {
    const whole = (v) => (Math.abs(v) <= 3 ? String(+(10 ** v).toPrecision(2)) : `10${raised(v)}`);
    const every = Math.max(1, Math.ceil((to - from) / most)), at = [];
    for (let k = Math.ceil(from - 1e-9); k <= to + 1e-9; k++) if (k % every === 0) at.push(k);
    if (at.length > 2 || every > 1) return { at, words: whole, factor: "" };
    const fine = [];
    for (let k = Math.floor(from); k <= to; k++) for (const m of [1, 2, 5]) fine.push(k + Math.log10(m));
    const seen = fine.filter((v) => v >= from - 1e-9 && v <= to + 1e-9);
    const [plain] = linearTicks(10 ** from, 10 ** to, most);
    const chosen = seen.length > 1 ? seen : plain.filter((v) => v > 0).map(Math.log10);
    return { at: chosen, words: (v) => String(+(10 ** v).toPrecision(6)), factor: "" };
  }
  const [at, step] = linearTicks(from, to, most), top = Math.max(Math.abs(from), Math.abs(to));
  const power = top >= 1e5 || top < 1e-3 ? 3 * Math.floor(Math.log10(top) / 3) : 0, unit = 10 ** power;
  const decimals = Math.min(12, Math.max(0, -Math.floor(Math.log10(step / unit) + 1e-9)));
  const words = (v) => (v / unit).toFixed(decimals).replace(/^-(0(\.0+)?)$/, "$1").replace("-", "−");
  return { at, words, factor: power ? ` ×10${raised(power)}` : "" };
}

// How wide the words of a tick are, in px: measured as they are drawn; without a page by the widest digit of any font.
const wide = (() => {
  const pen = typeof document === "undefined" ? null : document.createElement("canvas").getContext("2d");
  if (pen) pen.font = TICK_FONT;
  return (words) => (pen ? pen.measureText(words).width : 7.7 * words.length);
})();

const widest = (tick) => Math.max(0, ...tick.at.map((v) => wide(tick.words(v))));
const leftRoom = (tick) => Math.max(LEAST_LEFT_PX, Math.ceil(GAP_PX + widest(tick)) + 2);

// The ticks of a scale that lies, as many as stand beside one another.
function apart(scale, from, to, room) {
  for (let most = room / 75; ; most *= 0.7) {
    const found = ticks(scale, from, to, most);
    if (most < 1 || found.at.length < 3 || found.at.length * (widest(found) + 8) <= room) return found;
  }
}

// --- Panels ---

const DASHES = { dashed: "7 4", dotted: "2 3" };
const escaped = (text) => text.replace(/[&<>"]/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[c]);

class Panel {
  constructor(spec, arrays, element, figure) {
    Object.assign(this, spec, { element, figure, number: Panel.made++ });
    this.curves = spec.curves.map((c) => {
      const of = (k) => (k === undefined ? undefined : arrays[k]);
      const x = of(c.x);
      return { ...c, x, y: of(c.y), low: of(c.low), high: of(c.high), sorted: c.style !== "points" && ascends(x) };
    });
    this.svg = element.querySelector("svg");
    this.whole = this.wholeRange();
    this.x.key = `${this.x.label}|${this.whole.map((v) => v.toPrecision(3)).join("|")}`;
    this.listen();
  }

  wholeRange() {
    const x = this.x, to = (v) => (x.log ? log10(v) : v);
    if (x.span) return x.span.map(to);
    if (x.names) return [-0.5, x.names.length - 0.5];
    const bars = this.curves.some((c) => c.style === "bars"), dots = this.curves.every((c) => c.style === "points");
    const [a, b] = extent([...this.curves.map((c) => (x.log ? Array.from(c.x, log10) : c.x)), bars ? [0] : []]);
    const more = bars || dots ? 0.04 * (b - a) : 0;
    return [bars && a === 0 ? 0 : a - more, b + more];
  }

  range() { return this.group.range ?? this.whole; }
  zoom(from, to) { this.group.zoom(from, to); }
  all() { this.group.zoom(); }
  rows(k) { return { x: Array.from(this.curves[k].x), y: Array.from(this.curves[k].y) }; }

  drawn(k) {
    const curve = this.curves[k], [from, to] = this.range().map((v) => (this.x.log ? 10 ** v : v));
    if (!curve.sorted) return this.rows(k);
    const [x, y] = view(curve.x, curve.y, from, to, MOST_IN_VIEW);
    return { x, y };
  }

  yRange(shown) {
    const y = this.y, to = (v) => (y.log ? log10(v) : v);
    if (y.names) return y.span ?? [-0.5, y.names.length - 0.5];
    if (y.span && !this.group.range) return y.span.map(to);
    const [left, right] = this.range(), lists = [];
    for (const { curve, x, y: values } of shown) {
      if (curve.style === "bars") { lists.push(Array.from(values, (v) => v - curve.width / 2), Array.from(values, (v) => v + curve.width / 2)); continue; }
      const inside = (_, k) => { const at = this.x.log ? log10(x[k]) : x[k]; return at >= left && at <= right; };
      for (const one of [values, ...(curve.low && !this.group.range ? [curve.low, curve.high] : [])]) {
        lists.push(Array.from(one).filter(inside).map(to));
      }
    }
    const [a, b] = extent(lists), more = 0.05 * (b - a);
    return [a - more, b + more];
  }

  // What is drawn at this width, and the room that the words of its scale take on the left; names that would take too
  // much of a panel stand inside.
  lay(width) {
    const hidden = this.figure.hidden;
    const shown = this.curves.map((curve, k) => ({ curve, ...this.drawn(k) })).filter((s) => !hidden.has(s.curve.label));
    const named = BESIDE_PX + NAME_PX * (this.y.names?.length ?? 0), [low, high] = this.yRange(shown);
    const height = Math.max(named, Math.round((Figure.printing ? PRINT_ROW_PX : ROW_PX) * this.figure.rowHeight));
    const ty = ticks(this.y, low, high, (height - BESIDE_PX) / 38), left = leftRoom(ty);
    const narrow = this.y.names !== undefined && (width < 420 || left > 0.4 * width);
    this.plan = { shown, height, low, high, ty, narrow };
    return narrow ? LEAST_LEFT_PX : left;
  }

  draw(width, left) {
    const { shown, height, low, high, ty, narrow } = this.plan, [a, b] = this.range();
    const box = { left, right: width - RIGHT_PX, top: 6, bottom: height - BESIDE_PX + 6 };
    this.box = box;
    this.toX = (v) => box.left + (((this.x.log ? log10(v) : v) - a) / (b - a)) * (box.right - box.left);
    this.toY = (v) => box.bottom - (((this.y.log ? log10(v) : v) - low) / (high - low)) * (box.bottom - box.top);
    const tx = apart(this.x, a, b, box.right - box.left);
    this.factors(tx.factor, ty.factor);
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.svg.setAttribute("width", width);
    this.svg.setAttribute("height", height);
    this.svg.innerHTML = this.grid(tx, ty, narrow) + `<clipPath id="clip${this.number}"><rect x="${box.left}" y="${box.top}"`
      + ` width="${Math.max(box.right - box.left, 1)}" height="${box.bottom - box.top}"/></clipPath>`
      + `<g clip-path="url(#clip${this.number})">${shown.map((s) => this.mark(s)).join("")}</g>`
      + (narrow ? this.namesInside(ty) : "") + '<line class="cross"/><rect class="chosen"/>';
  }

  factors(x, y) {
    this.element.querySelector(".y-factor").textContent = y;
    this.element.querySelector(".x-factor").textContent = x;
  }

  grid(tx, ty, narrow) {
    const { left, right, top, bottom } = this.box, at = (v, log) => (log ? 10 ** v : v), parts = [];
    for (const v of tx.at) {
      const x = this.toX(at(v, this.x.log)).toFixed(1), words = tx.words(v), half = wide(words) / 2 + 1;
      const middle = Math.max(half, Math.min(x, right + RIGHT_PX - half)).toFixed(1);
      parts.push(`<path class="grid" d="M${x} ${top}V${bottom}"/><text x="${middle}" y="${bottom + 15}" text-anchor="middle">${escaped(words)}</text>`);
    }
    for (const v of ty.at) {
      const y = this.toY(at(v, this.y.log)).toFixed(1);
      parts.push(`<path class="grid" d="M${left} ${y}H${right}"/>`);
      if (!narrow) parts.push(`<text x="${left - GAP_PX}" y="${+y + 4}" text-anchor="end">${escaped(ty.words(v))}</text>`);
    }
    parts.push(`<path class="frame" d="M${left} ${top}V${bottom}H${right}"/>`);
    return parts.join("");
  }

  namesInside(ty) {
    return ty.at.map((v) => `<text class="inside" x="${this.box.left + 4}" y="${this.toY(v) - 5}">${escaped(ty.words(v))}</text>`).join("");
  }

  mark({ curve, x, y }) {
    const look = `stroke="var(--${curve.colour})" stroke-width="${curve.width}"`, fill = `fill="var(--${curve.colour})"`;
    const at = (k) => this.toX(x[k]).toFixed(1), parts = [];
    if (curve.style === "bars") {
      for (let k = 0; k < x.length; k++) {
        const [from, to] = [this.toX(0), this.toX(x[k])].sort((p, q) => p - q), up = this.toY(y[k] + curve.width / 2);
        parts.push(`<rect ${fill} x="${from}" y="${up}" width="${to - from}" height="${this.toY(y[k] - curve.width / 2) - up}"/>`);
      }
    } else if (curve.style === "points") {
      for (let k = 0; k < x.length; k++) {
        if (curve.low) parts.push(`<path fill="none" ${look} d="M${at(k)} ${this.toY(curve.low[k])}V${this.toY(curve.high[k])}"/>`);
        parts.push(`<circle ${fill} r="3" cx="${at(k)}" cy="${this.toY(y[k]).toFixed(1)}"/>`);
      }
    } else {
      if (curve.low) parts.push(`<path ${fill} fill-opacity="0.2" d="${this.outline(curve)}"/>`);
      const dash = DASHES[curve.style] ? ` stroke-dasharray="${DASHES[curve.style]}"` : "";
      parts.push(`<path fill="none" ${look}${dash} stroke-linejoin="round" d="${this.path(x, y)}"/>`);
    }
    return parts.join("");
  }

  path(x, y) {
    let pen = "M", out = "";
    for (let k = 0; k < x.length; k++) {
      const px = this.toX(x[k]), py = this.toY(y[k]);
      if (!Number.isFinite(px) || !Number.isFinite(py)) { pen = "M"; continue; }
      out += `${pen}${px.toFixed(1)} ${Math.max(-1e5, Math.min(1e5, py)).toFixed(1)}`;
      pen = "L";
    }
    return out;
  }

  outline(curve) {
    const back = (list) => Array.from(list).reverse();
    return `${this.path([...curve.x, ...back(curve.x)], [...curve.high, ...back(curve.low)])}Z`;
  }

  // --- Pointer and keys ---

  listen() {
    const to = (event) => event.clientX - this.svg.getBoundingClientRect().left;
    const chosen = () => this.svg.querySelector(".chosen");
    let begun = null;
    this.svg.addEventListener("pointerdown", (event) => { if (event.button === 0) begun = to(event); });
    this.svg.addEventListener("pointermove", (event) => {
      if (begun !== null && Math.abs(to(event) - begun) > 6) {
        this.svg.setPointerCapture(event.pointerId);
        const [p, q] = [begun, to(event)].sort((s, t) => s - t);
        const place = { x: p, y: this.box.top, width: q - p, height: this.box.bottom - this.box.top };
        for (const [name, value] of Object.entries(place)) chosen().setAttribute(name, value);
      } else this.point(to(event));
    });
    this.svg.addEventListener("pointerup", (event) => {
      const ends = begun === null ? [] : [begun, to(event)].sort((s, t) => s - t).map((px) => this.scaleAt(px));
      const far = begun !== null && Math.abs(to(event) - begun) > 6;
      begun = null;
      if (far) this.zoom(...ends);
    });
    this.svg.addEventListener("pointercancel", () => { begun = null; chosen().removeAttribute("width"); });
    this.svg.addEventListener("pointerleave", () => { if (begun === null) this.point(null); });
    this.svg.addEventListener("dblclick", () => this.all());
    this.element.addEventListener("keydown", (event) => {
      const act = { "+": "in", "=": "in", "-": "out", 0: "all", ArrowLeft: "left", ArrowRight: "right" }[event.key];
      if (act && !event.ctrlKey && !event.metaKey) { event.preventDefault(); this.group.act(act); }
    });
  }

  scaleAt(px) {
    const [a, b] = this.range();
    return a + ((px - this.box.left) / (this.box.right - this.box.left)) * (b - a);
  }

  // The values under the pointer, those nearest to it first; null: none.
  point(px) {
    const box = this.element.querySelector(".readout"), cross = this.svg.querySelector(".cross");
    const out = px === null || px < this.box.left || px > this.box.right;
    cross.setAttribute("d", "");
    for (const [name, value] of Object.entries(out ? { x1: -9, x2: -9 } : { x1: px, x2: px, y1: this.box.top, y2: this.box.bottom })) {
      cross.setAttribute(name, value);
    }
    if (out) { box.hidden = true; return; }
    const at = this.x.log ? 10 ** this.scaleAt(px) : this.scaleAt(px), lines = [];
    for (const curve of this.curves) {
      if (!curve.sorted || curve.style === "bars" || this.figure.hidden.has(curve.label) || !curve.x.length) continue;
      const k = Math.min(place(curve.x, at), curve.x.length - 1);
      const value = this.y.names ? this.y.names[Math.round(curve.y[k])] ?? "" : String(+curve.y[k].toPrecision(7));
      lines.push(`${curve.detail || curve.label || this.y.label}: ${value}`);
    }
    box.hidden = !lines.length;
    box.textContent = [`${+at.toPrecision(6)} (${this.x.label})`, ...lines.slice(0, HOVERED), ...(lines.length > HOVERED ? ["…"] : [])].join("\n");
    box.style.left = px > (this.box.left + this.box.right) / 2 ? `${this.box.left + 4}px` : `${Math.min(px + 12, this.box.right - 140)}px`;
  }
}
Panel.made = 0; // for ids

// Panels whose scale over x is the same: they are zoomed together, in whatever figures they stand.
class Group {
  constructor() { this.panels = []; this.range = null; }

  zoom(from, to) {
    const [a, b] = this.panels[0].whole;
    const ends = from === undefined ? [a, b] : [Math.max(Math.min(from, to), a), Math.min(Math.max(from, to), b)];
    if (!(ends[1] - ends[0] > 1e-9 * (b - a))) return;
    this.range = ends[0] <= a && ends[1] >= b ? null : ends;
    for (const figure of new Set(this.panels.map((panel) => panel.figure))) figure.draw();
  }

  act(what) {
    const [a, b] = this.range ?? this.panels[0].whole, width = b - a, whole = this.panels[0].whole;
    if (what === "all") this.zoom();
    if (what === "in") this.zoom(a + width / 4, b - width / 4);
    if (what === "out") this.zoom(a - width / 2, b + width / 2);
    const move = what === "left" ? -Math.min(width / 4, a - whole[0]) : what === "right" ? Math.min(width / 4, whole[1] - b) : 0;
    if (move) this.zoom(a + move, b + move);
  }
}

class Figure {
  constructor(spec, arrays, element) {
    Object.assign(this, { element, columns: spec.columns, rowHeight: spec.row_height, hidden: new Set() });
    this.grid = element.querySelector(".panels");
    const places = [...this.grid.children];
    this.panels = spec.panels.map((panel, k) => new Panel(panel, arrays, places[k], this));
    for (const button of element.querySelectorAll(".legend button")) {
      button.addEventListener("click", () => {
        const label = button.textContent.trim(), off = this.hidden.delete(label) || !this.hidden.add(label);
        button.setAttribute("aria-pressed", String(off));
        this.draw();
      });
    }
    for (const button of element.querySelectorAll(".tools button")) {
      button.addEventListener("click", () => new Set(this.panels.map((p) => p.group)).forEach((g) => g.act(button.dataset.act)));
    }
  }

  // In columns where they are wide enough, else one below the other, a column of the figure after the other.
  draw() {
    const width = Figure.printing ? PRINT_PX : this.grid.clientWidth, gap = 16;
    const columns = (width - gap * (this.columns - 1)) / this.columns >= LEAST_COLUMN_PX ? this.columns : 1;
    this.grid.style.gridTemplateColumns = `repeat(${columns}, minmax(0, 1fr))`;
    const each = Math.floor((width - gap * (columns - 1)) / columns), rows = Math.ceil(this.panels.length / this.columns);
    this.panels.forEach((panel, k) => {
      panel.element.style.order = columns === 1 ? (k % this.columns) * rows + Math.floor(k / this.columns) : k;
    });
    const lefts = this.panels.map((panel) => panel.lay(each)), widest = Math.max(...lefts);
    this.panels.forEach((panel, k) => panel.draw(each, columns === 1 ? widest : lefts[k]));
  }
}

async function begin() {
  const data = JSON.parse(document.getElementById("page-data")?.textContent ?? '{"arrays": [], "figures": []}');
  const arrays = await Promise.all(data.arrays.map(loaded)), groups = new Map(), figures = {};
  for (const spec of data.figures) {
    const figure = new Figure(spec, arrays, document.getElementById(`figure-${spec.name}`));
    figures[spec.name] = figure;
    for (const panel of figure.panels) {
      if (!groups.has(panel.x.key)) groups.set(panel.x.key, new Group());
      panel.group = groups.get(panel.x.key);
      panel.group.panels.push(panel);
      panel.element.dataset.group = panel.x.key;
    }
  }
  const draw = () => Object.values(figures).forEach((figure) => figure.draw());
  const folded = () => document.querySelectorAll("details:not([open])");
  const print = (now) => {
    if (Figure.printing === now) return;
    Figure.printing = now;
    if (now) folded().forEach((part) => { part.open = true; part.dataset.folded = ""; });
    else document.querySelectorAll("[data-folded]").forEach((part) => { part.open = false; delete part.dataset.folded; });
    draw();
  };
  draw();
  let width = window.innerWidth;
  window.addEventListener("resize", () => { if (!Figure.printing && window.innerWidth !== width) { width = window.innerWidth; draw(); } });
  window.addEventListener("beforeprint", () => print(true));
  window.addEventListener("afterprint", () => print(false));
  window.matchMedia("print").addEventListener("change", (event) => print(event.matches));
  window.servodFigures = figures;
  document.documentElement.dataset.ready = "1";
}

Figure.printing = false;
if (typeof document === "undefined") module.exports = { loaded, view, ticks, extent, leftRoom, apart, wide };
else window.servodReady = begin();
