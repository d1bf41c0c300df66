"use strict";
// Maps: dragging, the wheel, pinching and buttons move a map. A pointer or a tap shows the text of a mark, else the bound or
// the position.
for (const map of document.querySelectorAll(".map")) {
  const svg = map.querySelector("svg"), out = map.querySelector("output"), help = out.textContent;
  const data = JSON.parse(map.querySelector("script").textContent);
  const whole = svg.getAttribute("viewBox").split(" ").map(Number);
  let view = [...whole];
  const unit = () => {
    const { width, height } = svg.getBoundingClientRect();
    return Math.max(view[2] / Math.max(width, 1), view[3] / Math.max(height, 1));
  };
  const bar = map.querySelector(".scale");
  // The longest length of 1, 2, 5, 10, ... metres that fits in 120 pixels; a degree of latitude is 111.2 km long.
  const measure = () => {
    const metres = unit() * 111195 / Math.abs(data.scale[1]), most = 120 * metres;
    const power = 10 ** Math.floor(Math.log10(most)), length = power * [5, 2, 1].find(n => n * power <= most);
    bar.style.width = `${length / metres}px`;
    bar.textContent = length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m` : `${+(length * 100).toFixed(2)} cm`;
    // Shores are inaccurate by kilometres. On a map of a city, the style shows that they are only approximate.
    svg.classList.toggle("near", metres < 20);
  };
  const show = () => {
    svg.setAttribute("viewBox", view.join(" "));
    svg.style.setProperty("--unit", unit());
    svg.classList.toggle("far", view[2] > 1.7 * whole[2]);
    measure();
  };
  const place = event => {
    const box = svg.getBoundingClientRect(), u = unit();
    return [view[0] + view[2] / 2 + (event.clientX - box.left - box.width / 2) * u,
      view[1] + view[3] / 2 + (event.clientY - box.top - box.height / 2) * u];
  };
  const zoom = (by, [x, y] = [view[0] + view[2] / 2, view[1] + view[3] / 2]) => {
    const size = Math.min(Math.max(view[2] / by, whole[2] / (data.nearest ?? 200)), whole[2] * 2.5), f = size / view[2];
    view = [x + (view[0] - x) * f, y + (view[1] - y) * f, size, view[3] * f];
    show();
  };
  const where = ([px, py]) => {
    const lon = data.middle[0] + px / data.scale[0], lat = data.middle[1] + py / data.scale[1];
    const turned = ((lon + 540) % 360) - 180, digits = data.values ? 4 : 5;
    const text = `${Math.abs(lat).toFixed(digits)}° ${lat < 0 ? "S" : "N"}, ${Math.abs(turned).toFixed(digits)}° ${turned < 0 ? "W" : "E"}`;
    return [lon, lat, text];
  };
  // The text of the mark at a pixel or 6 pixels from it: marks are smaller than fingers.
  const marked = event => {
    for (const [dx, dy] of [[0, 0], [6, 0], [-6, 0], [0, 6], [0, -6]]) {
      const mark = document.elementFromPoint(event.clientX + dx, event.clientY + dy)?.closest?.("[data-tell]");
      if (mark && svg.contains(mark)) return mark.dataset.tell;
    }
    return null;
  };
  const tell = event => {
    const text = marked(event), [lon, lat, at] = where(place(event));
    if (text !== null || !data.values) { out.textContent = text ?? at; return; }
    const [x0, x1, nx] = data.x, [y0, y1, ny] = data.y;
    const i = Math.round((lon - x0) / (x1 - x0) * (nx - 1)), j = Math.round((lat - y0) / (y1 - y0) * (ny - 1));
    const value = i >= 0 && i < nx && j >= 0 && j < ny ? data.values[j * nx + i] : null;
    out.textContent = value === null ? `${at}: no bound here` : `${at}: bound ${value < 1000 ? value + " m" : value / 1000 + " km"}`;
  };
  const fingers = new Map();
  const spread = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
  };
  svg.addEventListener("pointerdown", event => { svg.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); });
  svg.addEventListener("pointermove", event => {
    const old = fingers.get(event.pointerId);
    if (!old) { tell(event); return; }
    if (fingers.size === 1) {
      const u = unit();
      view[0] -= (event.clientX - old.clientX) * u;
      view[1] -= (event.clientY - old.clientY) * u;
      fingers.set(event.pointerId, event);
      show();
    } else if (fingers.size === 2) {
      const before = spread();
      fingers.set(event.pointerId, event);
      if (before > 0) zoom(spread() / before, place(event));
    }
    tell(event);
  });
  for (const end of ["pointerup", "pointercancel"])
    svg.addEventListener(end, event => { fingers.delete(event.pointerId); if (end === "pointerup") tell(event); });
  svg.addEventListener("pointerleave", () => { if (!fingers.size) out.textContent = help; });
  svg.addEventListener("wheel", event => { event.preventDefault(); zoom(event.deltaY < 0 ? 1.2 : 1 / 1.2, place(event)); }, { passive: false });
  map.querySelector(".tools").addEventListener("click", event => {
    const what = event.target.dataset.do;
    if (what === "in") zoom(1.5);
    else if (what === "out") zoom(1 / 1.5);
    else if (what === "all") { view = [...whole]; show(); }
    else if (what === "focus") {
      const [x, y, width] = data.focus, height = width * whole[3] / whole[2];
      view = [x - width / 2, y - height / 2, width, height];
      show();
    }
  });
  map.querySelector(".layers").addEventListener("change", event => {
    svg.querySelector(`[data-layer="${event.target.value}"]`).style.display = event.target.checked ? "" : "none";
  });
  addEventListener("resize", show);
  show();
}
