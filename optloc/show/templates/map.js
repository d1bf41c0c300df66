// Maps: dragging, the wheel, pinching, keys and buttons move a map. A pointer or a tap shows the text of a mark, else the
// bound or the position.

const openMap = map => {
  const sheet = map.querySelector(".sheet"), out = map.querySelector("output"), help = out.textContent;
  const data = JSON.parse(map.querySelector("script").textContent);
  const whole = sheet.getAttribute("viewBox").split(" ").map(Number);
  const grid = sheet.querySelector('[data-layer="grid"]'), bar = map.querySelector(".scale");
  let view = [...whole], kept = help, waiting = false;
  const unit = () => {
    const { width, height } = sheet.getBoundingClientRect();
    return Math.max(view[2] / Math.max(width, 1), view[3] / Math.max(height, 1));
  };
  const area = u => {
    const { width, height } = sheet.getBoundingClientRect(), x = view[0] + view[2] / 2, y = view[1] + view[3] / 2;
    return [x - width * u / 2, y - height * u / 2, x + width * u / 2, y + height * u / 2];
  };
  const measure = u => {
    const perMetre = Math.abs(data.scale[1]) / (data.flat ? 1 : 111195), length = round125(140 * u / perMetre);
    bar.style.width = `${length * perMetre / u}px`;
    bar.textContent = metreText(length);
    // Shores are inaccurate by kilometres. On a map of a city, the style shows that they are only approximate.
    sheet.classList.toggle("near", u / perMetre < 20);
  };
  // Grid and labels take milliseconds, so they follow once for each picture of the screen.
  const lay = () => {
    waiting = false;
    const u = unit(), visible = area(u);
    if (grid.style.display !== "none") drawGrid(grid, data, visible, u);
    layLabels(sheet, visible, u);
  };
  const show = () => {
    const u = unit();
    sheet.setAttribute("viewBox", view.join(" "));
    sheet.style.setProperty("--unit", u);
    sheet.classList.toggle("far", view[2] > 2 * whole[2]);
    measure(u);
    if (!waiting) { waiting = true; requestAnimationFrame(lay); }
  };
  const place = event => {
    const box = sheet.getBoundingClientRect(), u = unit();
    return [view[0] + view[2] / 2 + (event.clientX - box.left - box.width / 2) * u,
      view[1] + view[3] / 2 + (event.clientY - box.top - box.height / 2) * u];
  };
  const centre = () => [view[0] + view[2] / 2, view[1] + view[3] / 2];
  const zoom = (by, [x, y] = centre()) => {
    const size = Math.min(Math.max(view[2] / by, whole[2] / (data.nearest ?? 200)), whole[2] * 2.5), f = size / view[2];
    view = [x + (view[0] - x) * f, y + (view[1] - y) * f, size, view[3] * f];
    show();
  };
  const pan = (dx, dy) => { view[0] += dx; view[1] += dy; show(); };
  const where = ([px, py]) => {
    const x = data.middle[0] + px / data.scale[0], y = data.middle[1] + py / data.scale[1];
    if (data.flat) {
      const digits = Math.max(0, Math.ceil(-Math.log10(unit() / data.scale[0])));
      return [x, y, `x ${x.toFixed(digits)} m, y ${y.toFixed(digits)} m`];
    }
    const turned = ((x + 540) % 360) - 180, digits = data.values ? 4 : 5;
    const text = `${Math.abs(y).toFixed(digits)}° ${y < 0 ? "S" : "N"}, ${Math.abs(turned).toFixed(digits)}° ${turned < 0 ? "W" : "E"}`;
    return [x, y, text];
  };
  // The mark at a pixel or 8 pixels from it: marks are smaller than fingers.
  const marked = event => {
    for (const [dx, dy] of [[0, 0], [8, 0], [-8, 0], [0, 8], [0, -8]]) {
      const mark = document.elementFromPoint(event.clientX + dx, event.clientY + dy)?.closest?.("[data-tell]");
      if (mark && sheet.contains(mark)) return mark;
    }
    return null;
  };
  const tell = event => {
    const mark = marked(event), [x, y, at] = where(place(event));
    if (mark || !data.values) { out.textContent = mark?.dataset.tell ?? at; return; }
    const [x0, x1, nx] = data.x, [y0, y1, ny] = data.y;
    const i = Math.round((x - x0) / (x1 - x0) * (nx - 1)), j = Math.round((y - y0) / (y1 - y0) * (ny - 1));
    const value = i >= 0 && i < nx && j >= 0 && j < ny ? data.values[j * nx + i] : null;
    out.textContent = value === null ? `${at}: no bound here` : `${at}: bound ${value < 1000 ? value + " m" : value / 1000 + " km"}`;
  };
  const keep = text => { kept = text; out.textContent = text; };
  // Move the map if a point of the drawing is outside its visible part.
  const reveal = ([x, y]) => {
    const [left, top, right, bottom] = area(unit());
    if (x < left || x > right || y < top || y > bottom) { view[0] = x - view[2] / 2; view[1] = y - view[3] / 2; show(); }
  };
  const list = listOf(map, { tell: keep, reveal });
  const fingers = new Map();
  let start = null;
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
  };
  sheet.addEventListener("pointerdown", event => {
    sheet.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, event);
    start = fingers.size === 1 ? event : null;
  });
  sheet.addEventListener("pointermove", event => {
    const old = fingers.get(event.pointerId);
    if (!old) { tell(event); return; }
    if (fingers.size === 1) {
      const u = unit();
      pan(-(event.clientX - old.clientX) * u, -(event.clientY - old.clientY) * u);
      fingers.set(event.pointerId, event);
    } else if (fingers.size === 2) {
      const before = spread();
      fingers.set(event.pointerId, event);
      if (before > 0) zoom(spread() / before, place(event));
    }
    tell(event);
  });
  // A pointer that has hardly moved selects the mark below it.
  const tap = event => {
    if (!start || Math.hypot(event.clientX - start.clientX, event.clientY - start.clientY) > 6) return;
    const mark = marked(event);
    if (mark?.dataset.row !== undefined && list.pickNumber(mark.dataset.row)) return;
    list.pick(null);
    tell(event);
    kept = out.textContent;
  };
  for (const end of ["pointerup", "pointercancel"])
    sheet.addEventListener(end, event => { fingers.delete(event.pointerId); if (end === "pointerup") tap(event); });
  sheet.addEventListener("pointerleave", () => { if (!fingers.size) out.textContent = kept; });
  sheet.addEventListener("wheel", event => { event.preventDefault(); zoom(event.deltaY < 0 ? 1.2 : 1 / 1.2, place(event)); }, { passive: false });
  const all = () => { view = [...whole]; show(); };
  const focus = () => {
    const [x, y, width] = data.focus, height = width * whole[3] / whole[2];
    view = [x - width / 2, y - height / 2, width, height];
    show();
  };
  const actions = { in: () => zoom(1.5), out: () => zoom(1 / 1.5), all, focus };
  map.querySelector(".tools").addEventListener("click", event => actions[event.target.dataset.do]?.());
  sheet.addEventListener("keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const step = 80 * unit();
    const keys = {
      ArrowLeft: () => pan(-step, 0), ArrowRight: () => pan(step, 0), ArrowUp: () => pan(0, -step), ArrowDown: () => pan(0, step),
      "+": actions.in, "=": actions.in, "-": actions.out, 0: all, Home: all, Enter: () => list.pickNearest(centre()),
    };
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });
  map.querySelector(".layers").addEventListener("change", event => {
    sheet.querySelector(`[data-layer="${CSS.escape(event.target.value)}"]`).style.display = event.target.checked ? "" : "none";
    show();
  });
  addEventListener("resize", show);
  show();
  return { map, sheet, data, list, show, keep };
};

const openMaps = [...document.querySelectorAll(".map")].map(openMap);
