// Draws figures as SVG: bands, lines, dots and bars over steps or sensors, and a wing from above.
"use strict";

const COLOURS = {
  present: "#009e73", prediction: "#d55e00", truth: "#000000", observed: "#595959", decision: "#cc79a7",
  reference: "#999999",
};
// Cividis, and white to vermilion: even steps of lightness, safe for colour-blind readers.
const SCALES = {
  magnitude: ["#00224e", "#123570", "#3b496c", "#575d6d", "#707173", "#8a8678", "#a59c74", "#c3b369", "#e1cc55", "#fee838"],
  damage: ["#ffffff", "#d55e00"],
};
const LEAST_WIDTH = 120;
const MARGIN = { left: 52, right: 12, top: 8, bottom: 22 };

function escaped(text) {
  return String(text).replace(/[&<>"]/g, (sign) => `&#${sign.charCodeAt(0)};`);
}

function shortNumber(value) {
  return Number.isFinite(value) ? String(Number(value.toPrecision(4))) : "none";
}

// About so many round numbers between two ends.
function ticksOf(low, high, most) {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((part) => part * power).find((value) => value >= rough) ?? rough;
  const found = [];
  for (let count = Math.ceil(low / step); count * step <= high + 1e-9 * step; count++) {
    found.push(Number((count * step).toPrecision(12)));
  }
  return found;
}

function colourOf(scale, low, high, value) {
  const place = Math.min(Math.max((value - low) / (high - low || 1), 0), 1) * (scale.length - 1);
  const below = Math.min(Math.floor(place), scale.length - 2), share = place - below;
  const parts = [1, 3, 5].map((at) => {
    const [first, second] = [scale[below], scale[below + 1]].map((text) => parseInt(text.slice(at, at + 2), 16));
    return Math.round(first + share * (second - first));
  });
  return `rgb(${parts.join(",")})`;
}

// A figure with axes. `options`: unit, height, range or names of the vertical axis, and titles of the places 1, 2, ...
// of the horizontal one, which are shown if they fit; `reading` says what
// stands at a place of the horizontal axis, in lines of text.
class Plot {
  constructor(parent, title, options) {
    this.options = options;
    this.el = document.createElement("figure");
    this.el.innerHTML = `<figcaption>${escaped(title)}</figcaption><div class="plot"></div>`;
    parent.append(this.el);
    this.place = this.el.querySelector(".plot");
    this.sign = document.createElement("output");
    this.sign.className = "reading";
    this.sign.hidden = true;
    this.el.append(this.sign);
    this.el.addEventListener("pointermove", (event) => this.read(event));
    this.el.addEventListener("pointerleave", () => { this.sign.hidden = true; });
    new ResizeObserver(() => this.paint()).observe(this.place);
  }

  // `marks` are functions of this figure that return SVG; `values` are what the vertical axis has to hold.
  draw(range, values, marks, reading) {
    Object.assign(this, { range, values, marks, reading });
    this.paint();
  }

  paint() {
    if (this.marks === undefined) return;
    this.width = this.place.clientWidth;
    if (this.width < LEAST_WIDTH) return; // not laid out yet
    const { height, unit, names } = this.options, right = this.width - MARGIN.right, floor = height - MARGIN.bottom;
    const known = this.values.filter(Number.isFinite);
    let [low, high] = this.options.range ?? [Math.min(...known), Math.max(...known)];
    const room = this.options.range ? 0 : 0.08 * (high - low) || 1;
    [low, high] = known.length || this.options.range ? [low - room, high + room] : [0, 1];
    const [first, last] = this.range;
    this.x = (value) => MARGIN.left + ((value - first) / (last - first)) * (right - MARGIN.left);
    this.y = (value) => floor - ((value - low) / (high - low)) * (floor - MARGIN.top);
    const grid = (names ?? ticksOf(low, high, height / 32)).map((name, row) => {
      const at = names ? row + 0.4 : name, line = names ? this.y(row) : this.y(at);
      return `<path class="grid" d="M${MARGIN.left} ${line}H${right}"/>` +
        `<text x="${MARGIN.left - 6}" y="${this.y(at) + 4}" text-anchor="end">${escaped(names ? name : shortNumber(name))}</text>`;
    });
    const titles = this.options.titles ?? [];
    const fit = titles.length > 0 && titles.length * (7 * Math.max(...titles.map((title) => title.length)) + 6) < right - MARGIN.left;
    const steps = fit ? titles.map((_, index) => index + 1) : ticksOf(first, last, this.width / 80).filter((value) => Number.isInteger(value));
    const below = steps.map((value) =>
      `<text x="${this.x(value)}" y="${height - 6}" text-anchor="middle">${escaped(fit ? titles[value - 1] : String(value))}</text>`);
    const side = unit ? `<text transform="translate(11 ${(floor + MARGIN.top) / 2}) rotate(-90)" text-anchor="middle">${escaped(unit)}</text>` : "";
    this.place.innerHTML = `<svg viewBox="0 0 ${this.width} ${height}" width="${this.width}" height="${height}" role="img">` +
      `${grid.join("")}${below.join("")}${side}${this.marks.map((mark) => mark(this)).join("")}</svg>`;
  }

  read(event) {
    if (this.reading === undefined) return;
    const box = this.place.getBoundingClientRect(), [first, last] = this.range;
    const share = (event.clientX - box.left - MARGIN.left) / (this.width - MARGIN.left - MARGIN.right);
    const said = this.reading(Math.round(first + share * (last - first)));
    this.sign.hidden = said === null;
    if (said === null) return;
    this.sign.textContent = said.join("\n");
    this.sign.style.left = `${Math.min(event.clientX + 12, innerWidth - 200)}px`;
    this.sign.style.top = `${event.clientY + 14}px`;
  }
}

function pathOf(plot, x, values) {
  let pen = "M";
  return values.map((value, index) => {
    if (!Number.isFinite(value)) { pen = "M"; return ""; }
    const part = `${pen}${plot.x(x[index]).toFixed(1)} ${plot.y(value).toFixed(1)}`;
    pen = "L";
    return part;
  }).join("");
}

const line = (x, values, colour, look = "") => (plot) =>
  `<path d="${pathOf(plot, x, values)}" fill="none" stroke="${colour}" stroke-width="2" ${look}/>`;

const band = (x, lower, upper, colour) => (plot) => {
  const known = x.map((_, index) => index).filter((index) => Number.isFinite(lower[index]));
  const take = (values, order) => order.map((index) => values[index]), back = [...known].reverse();
  const outline = pathOf(plot, [...take(x, known), ...take(x, back)], [...take(upper, known), ...take(lower, back)]);
  return `<path d="${outline}" fill="${colour}" fill-opacity="0.22"/>`;
};

const SHAPES = {
  dot: (x, y, size) => `M${x - size} ${y}a${size} ${size} 0 1 0 ${2 * size} 0a${size} ${size} 0 1 0 ${-2 * size} 0`,
  diamond: (x, y, size) => `M${x - size} ${y}L${x} ${y - size}L${x + size} ${y}L${x} ${y + size}z`,
  square: (x, y, size) => `M${x - size} ${y - size}h${2 * size}v${2 * size}h${-2 * size}z`,
  dash: (x, y, size) => `M${x - size} ${y}h${2 * size}`,
  cross: (x, y, size) => `M${x - size} ${y - size}l${2 * size} ${2 * size}m0 ${-2 * size}l${-2 * size} ${2 * size}`,
};

const marks = (x, values, shape, size, look) => (plot) => {
  const drawn = values.map((value, index) =>
    Number.isFinite(value) ? SHAPES[shape](plot.x(x[index]), plot.y(value), size) : "");
  return `<path d="${drawn.join("")}" ${look}/>`;
};

// Bars of a width in units of the horizontal axis, from one value to another.
const bars = (x, bottom, top, width, colour, opacity) => (plot) => {
  const half = 0.5 * (plot.x(width) - plot.x(0));
  const drawn = x.map((place, index) => Number.isFinite(top[index]) && Number.isFinite(bottom[index])
    ? `M${plot.x(place) - half} ${plot.y(bottom[index])}h${2 * half}V${plot.y(top[index])}h${-2 * half}z` : "");
  return `<path d="${drawn.join("")}" fill="${colour}" fill-opacity="${opacity}"/>`;
};

// A wing from above, or the faces of another structure, with two scales of colours. `drawing` has the places of
// regions and gauges: those of `scene.planform` or `scene.part`.
class Structure {
  constructor(parent, title, drawing, sensors, factors) {
    Object.assign(this, { drawing, sensors, factors });
    this.el = document.createElement("figure");
    this.el.innerHTML = `<figcaption>${escaped(title)}</figcaption><div class="plot"></div>`;
    parent.append(this.el);
    this.place = this.el.querySelector(".plot");
    new ResizeObserver(() => this.paint()).observe(this.place);
  }

  draw(loss, said, observed) {
    Object.assign(this, { loss, said, observed });
    this.paint();
  }

  paint() {
    if (this.loss === undefined) return;
    const { drawing, sensors, factors } = this, width = this.place.clientWidth;
    if (width < LEAST_WIDTH) return;
    const points = drawing.faces ? drawing.faces.flat() : drawing.outline;
    const across = points.map((point) => point[0]), along = points.map((point) => point[1]);
    const [left, right, low, high] = [Math.min(...across), Math.max(...across), Math.min(...along), Math.max(...along)];
    const plot = drawing.faces ? 260 : 145, bottom = 25 + plot; // a wing fills its width, a part keeps its proportions
    const scaleX = drawing.faces ? Math.min((width - 20) / (right - left), plot / (high - low)) : (width - 20) / (right - left);
    const scaleY = drawing.faces ? scaleX : plot / (high - low);
    const margin = (width - scaleX * (right - left)) / 2;
    const x = (value) => margin + (value - left) * scaleX, y = (value) => bottom - (value - low) * scaleY;
    const outline = (corners) => corners.map((point) => `${x(point[0])},${y(point[1])}`).join(" ");
    const [least, most] = [Math.min(...factors.map((one) => one.levels[0])), Math.max(...factors.map((one) => one.levels.at(-1)))];
    const fillOf = (index) => { // no colour where no state is believed
      const loss = this.loss[index];
      return loss === null || loss === undefined ? "#f2f4f6" : colourOf(SCALES.damage, least, most, loss);
    };
    const body = drawing.faces ? this.faces(outline, fillOf) : this.regions(outline, fillOf, x, y);
    const [lowest, highest] = [Math.min(sensors.lowest, 0), sensors.highest];
    const gauges = drawing.gauges.map((place, index) => {
      const value = this.observed[index], told = `${sensors.titles[index]}: ${shortNumber(value)} ${sensors.unit}`;
      const [across, top] = [x(place[0]), y(place[1])];
      return Number.isFinite(value)
        ? `<circle cx="${across}" cy="${top}" r="5.5" fill="${colourOf(SCALES.magnitude, lowest, highest, value)}" stroke="#000000" stroke-width="0.6"><title>${escaped(told)}</title></circle>`
        : `<path class="lost" d="${SHAPES.cross(across, top, 4.5)}" stroke="#000000" stroke-width="2"><title>${escaped(sensors.titles[index])}: lost</title></path>`;
    });
    this.top = bottom + 20;
    const keys = [this.key(0, width / 2, "damage", least, most, `expected loss (${factors[0].unit})`),
      this.key(width / 2, width / 2, "magnitude", lowest, highest, `${sensors.quantity} (${sensors.unit})`)];
    const hasRegions = drawing.faces ? drawing.region.some((index) => index >= 0) : drawing.regions.length > 0;
    const height = this.top + 40;
    this.place.innerHTML = `<svg viewBox="0 0 ${width} ${height}" width="${width}" height="${height}" role="img">` +
      `${body}${gauges.join("")}${(hasRegions ? keys : keys.slice(1)).join("")}</svg>`;
  }

  // The regions of a wing, each with what is believed of it above.
  regions(outline, fillOf, x, y) {
    const regions = this.drawing.regions.map((region, index) => {
      const middle = region.reduce((sum, point) => sum + point[0], 0) / region.length;
      const top = Math.max(...region.map((point) => point[1]));
      return `<polygon points="${outline(region)}" fill="${fillOf(index)}" stroke="#000000"/>` +
        `<text x="${x(middle)}" y="${y(top) - 4}" text-anchor="middle">${escaped(this.said[index])}</text>`;
    });
    return `<polygon points="${outline(this.drawing.outline)}" fill="#f2f4f6" stroke="${COLOURS.reference}"/>${regions.join("")}`;
  }

  // The faces of a part, those of regions with black edges; what is believed of a region shows at its faces.
  faces(outline, fillOf) {
    return this.drawing.faces.map((face, number) => {
      const index = this.drawing.region[number];
      if (index < 0) return `<polygon points="${outline(face)}" fill="#f2f4f6" stroke="${COLOURS.reference}" stroke-width="0.5"/>`;
      const told = `${this.factors[index].title}: ${this.said[index]}`;
      return `<polygon points="${outline(face)}" fill="${fillOf(index)}" stroke="#000000" stroke-width="0.5"><title>${escaped(told)}</title></polygon>`;
    }).join("");
  }

  key(left, width, scale, low, high, title) {
    const count = 40, step = (width - 24) / count;
    const cells = Array.from({ length: count }, (_, cell) =>
      `<rect x="${left + 12 + cell * step}" y="${this.top}" width="${step + 0.5}" height="8" fill="${colourOf(SCALES[scale], 0, count - 1, cell)}"/>`);
    return `${cells.join("")}<text x="${left + 12}" y="${this.top + 22}">${shortNumber(low)}</text>` +
      `<text x="${left + width / 2}" y="${this.top + 22}" text-anchor="middle">${escaped(title)}</text>` +
      `<text x="${left + width - 12}" y="${this.top + 22}" text-anchor="end">${shortNumber(high)}</text>`;
  }
}
