// Labels and grid of a map. `sheet` is the SVG, `area` the visible part [left, top, right, bottom] in units of the drawing,
// and `unit` the units of the drawing in a pixel.

// Positions of a name around its mark in pixels, and the anchor of its text; the first free position is used.
const besides = [[9, -6, "start"], [-9, -6, "end"], [9, 15, "start"], [-9, 15, "end"]];
const importance = ["name", "mark", "level", "along", "coordinate", "city"];
// Width of a letter in pixels, for labels whose width is not known because their layer is hidden.
const letter = 6.6;

// Number of marks that labels avoid; more marks cover the map.
const marksAtMost = 400;

const labelWidth = (label, unit) => {
  if (!label.pixels) {
    const length = label.getComputedTextLength();
    if (!length) return letter * label.textContent.length;
    label.pixels = length / unit;
  }
  return label.pixels;
};

const hiddenLayer = element => element.parentNode.style.display === "none";

// Show each label that overlaps no more important label and no mark.
const layLabels = (sheet, area, unit) => {
  // The buttons and the scale bar cover two corners.
  const [left, top, , bottom] = area;
  const taken = [[left, top, left + 50 * unit, top + 170 * unit], [left, bottom - 30 * unit, left + 155 * unit, bottom]];
  for (const mark of sheet.querySelectorAll("[data-tell].dot, g[data-tell]")) {
    if (hiddenLayer(mark)) continue;
    const place = mark.getAttribute("d") ?? mark.getAttribute("transform");
    const [x, y] = place.match(/-?[\d.]+(?:e-?\d+)?/g).map(Number);
    taken.push([x - 6 * unit, y - 6 * unit, x + 6 * unit, y + 6 * unit]);
    if (taken.length > marksAtMost) break;
  }
  const free = box => box[0] > area[0] && box[2] < area[2] && box[1] > area[1] && box[3] < area[3]
    && !taken.some(other => box[0] < other[2] && other[0] < box[2] && box[1] < other[3] && other[1] < box[3]);
  const labels = [...sheet.querySelectorAll("text")].filter(label => !hiddenLayer(label));
  for (const label of labels) label.kind = importance.indexOf(label.classList[0]);
  labels.sort((a, b) => a.kind - b.kind);
  for (const label of labels) {
    const x = Number(label.getAttribute("x")), y = Number(label.getAttribute("y")), width = labelWidth(label, unit);
    const movable = label.kind < 2, end = label.getAttribute("text-anchor") === "end";
    const middle = label.classList.contains("level");
    let found = null;
    for (const [dx, dy, anchor] of movable ? besides : [[label.kind === 5 ? -3 : 0, label.kind === 5 ? 4 : 0, end ? "end" : "start"]]) {
      const left = x + dx * unit - (middle ? width * unit / 2 : anchor === "end" ? width * unit : 0), low = y + dy * unit;
      const box = [left, low - 11 * unit, left + width * unit, low + 3 * unit];
      if (free(box)) { found = [dx, dy, anchor, box]; break; }
    }
    label.classList.toggle("off", found === null);
    if (found === null) {
      // No name of a smaller city takes the place of a hidden one.
      if (label.kind === 5) taken.push([x - 25 * unit, y - 25 * unit, x + 25 * unit, y + 25 * unit]);
      continue;
    }
    taken.push(found[3]);
    if (movable) {
      label.setAttribute("text-anchor", found[2]);
      label.style.transform = `translate(${found[0] * unit}px, ${found[1] * unit}px)`;
    }
  }
};

const svgElement = (name, kind, values) => {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  made.setAttribute("class", kind);
  for (const [key, value] of Object.entries(values)) made.setAttribute(key, value);
  return made;
};

const metreText = length => length >= 1000 ? `${+(length / 1000).toPrecision(6)} km`
  : length >= 1 ? `${+length.toPrecision(6)} m` : `${+(length * 100).toPrecision(6)} cm`;

// The longest length of 1, 2, 5, 10, ... that is at most `most`.
const round125 = most => {
  const power = 10 ** Math.floor(Math.log10(most));
  return power * [5, 2, 1].find(n => n * power <= most * 1.0000001);
};

// Spacing of the grid: about this number of pixels. From this length on, m, the grid of a map on Earth has degrees.
const spacing = 120, degreesFrom = 200000;

const drawGrid = (layer, data, area, unit) => {
  if (!layer) return;
  const [left, top, right, bottom] = area, metre = data.flat ? 1 : 1 / 111195;
  const perMetre = Math.abs(data.scale[1]) * metre, length = round125(spacing * unit / perMetre);
  const degrees = !data.flat && length >= degreesFrom;
  const step = [1, 2, 5, 10, 15, 30, 45].find(n => n * data.scale[0] >= spacing * unit / 2) ?? 90;
  const origin = data.flat ? [-data.middle[0] * data.scale[0], -data.middle[1] * data.scale[1]] : data.origin ?? [0, 0];
  const lines = [], texts = [];
  // Text of a line number k, along x or along y.
  const say = (k, names) => {
    if (data.flat && k === 0) return names === "EW" ? "x 0" : "y 0";
    if (data.flat) return `${names === "EW" ? "x" : "y"} ${k < 0 ? "−" : ""}${metreText(Math.abs(k) * length)}`;
    if (k === 0) return "0";
    return `${metreText(Math.abs(k) * length)} ${names[k > 0 ? 0 : 1]}`;
  };
  const turned = lon => ((lon + 540) % 360 + 360) % 360 - 180;
  const sayDegrees = (value, names) => `${Math.abs(value)}°${value ? ` ${names[value > 0 ? 0 : 1]}` : ""}`;
  const along = (low, high, start, size, put) => {
    if (!(high - low < 60 * size)) return; // degrees of longitude near a pole
    for (let k = Math.ceil((low - start) / size); start + k * size < high; k += 1) put(k, start + k * size);
  };
  const sizes = degrees ? [step * data.scale[0], step * -data.scale[1]] : [length * perMetre, length * perMetre];
  const starts = degrees ? [-data.middle[0] * data.scale[0], -data.middle[1] * data.scale[1]] : origin;
  along(left, right, starts[0], sizes[0], (k, x) => {
    lines.push(`M${x} ${top}V${bottom}`);
    if (x < left + 52 * unit) return; // below the buttons
    const text = degrees ? sayDegrees(turned(k * step), "EW") : say(k, "EW");
    texts.push(svgElement("text", "coordinate", { x: x + 3 * unit, y: top + 14 * unit }));
    texts.at(-1).textContent = text;
  });
  along(top, bottom, starts[1], sizes[1], (k, y) => {
    if (degrees && Math.abs(k * step) > 90) return;
    lines.push(`M${left} ${y}H${right}`);
    const text = degrees ? sayDegrees(-k * step, "NS") : say(-k, "NS");
    texts.push(svgElement("text", "coordinate", { x: right - 4 * unit, y: y - 3 * unit, "text-anchor": "end" }));
    texts.at(-1).textContent = text;
  });
  layer.replaceChildren(svgElement("path", "gridline", { d: lines.join("") }), ...texts);
};
