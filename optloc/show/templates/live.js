// Request the latest fixes from the server of this page once a second, and draw them like fixes on other maps. Every text
// of the feed becomes text of the page, never HTML.

// Milliseconds between two requests, and until a request without an answer counts as lost.
const period = 1000, patience = 5000;
// Corners of an ellipse.
const corners = 48;

const openLive = ({ map, sheet, data, list, show }) => {
  const layers = Object.fromEntries(["trails", "ellipses", "fixes", "names"].map(name => [name, sheet.querySelector(`[data-layer="${name}"]`)]));
  const stationNames = [...layers.names.children];
  const items = map.querySelector(".list"), state = map.querySelector(".link"), counted = map.querySelector(".counted");
  let picked = null, last = "", lostSince = null, signature = "";
  const drawn = ([x, y]) => {
    const turned = data.flat ? x - data.middle[0] : ((x - data.middle[0] + 540) % 360 + 360) % 360 - 180;
    return [turned * data.scale[0], (y - data.middle[1]) * data.scale[1]];
  };
  const ring = (one, [x, y]) => {
    const [major, minor, bearing] = one.ellipse, unit = Math.abs(data.scale[1]) / (data.flat ? 1 : 111195);
    // The frame of the map is true to scale at its middle, and the bearing counts from north towards east.
    const angle = bearing * Math.PI / 180, squeeze = data.flat ? 1 : data.scale[0] / Math.abs(data.scale[1]) / Math.cos(one.at[1] * Math.PI / 180);
    const points = Array.from({ length: corners }, (_, k) => {
      const t = 2 * Math.PI * k / corners, a = major * Math.cos(t), b = minor * Math.sin(t);
      const east = a * Math.sin(angle) + b * Math.cos(angle), north = a * Math.cos(angle) - b * Math.sin(angle);
      return `${x + east * unit * squeeze} ${y - north * unit}`;
    });
    return svgElement("path", "ring", { d: `M${points.join("L")}Z` });
  };
  const span = (kind, text, tag = "span") => {
    const made = document.createElement(tag);
    if (kind) made.className = kind;
    made.textContent = text;
    return made;
  };
  const swatchOf = look => {
    const made = svgElement("svg", "swatch", { width: 22, height: 14, viewBox: "-11 -7 22 14", "aria-hidden": "true" });
    made.append(svgElement("path", `dot ${look}`, { "stroke-width": 11, d: "M0 0h0" }), svgElement("path", `dot centre ${look}`, { "stroke-width": 5, d: "M0 0h0" }));
    return made;
  };
  const rowOf = (one, number, at) => {
    const item = document.createElement("li"), pick = span("pick", "", "button"), place = span("place", ""), copy = span("copy", "Copy", "button");
    item.dataset.row = number;
    item.dataset.name = one.name;
    item.dataset.at = at.join(" ");
    pick.type = copy.type = "button";
    pick.setAttribute("aria-pressed", "false");
    pick.append(swatchOf(one.look), " ", span("", one.name, "b"), " ", span("status", one.status));
    if (one.time || one.seen) pick.append(" ", span("", one.time || one.seen, "time"));
    copy.dataset.copy = one.copied;
    copy.setAttribute("aria-label", `copy coordinates of ${one.name}`);
    place.append(span("", one.place, "code"), " ", copy);
    item.append(pick, place, ...[one.sentence, one.size, one.note].filter(Boolean).map(text => span("size", text)));
    return item;
  };
  const tellOf = one => [one.name, one.time || one.seen, one.status, one.sentence, one.place, one.size, one.note].filter(Boolean).join(", ");
  const draw = found => {
    const at = found.map(one => drawn(one.at)), size = found.length <= 12 ? 12 : 8;
    layers.trails.replaceChildren(...found.filter(one => one.trail.length > 1)
      .map(one => svgElement("path", "trail", { d: `M${one.trail.map(each => drawn(each).join(" ")).join("L")}` })));
    layers.ellipses.replaceChildren(...found.flatMap((one, i) => one.ellipse ? [ring(one, at[i])] : []));
    layers.fixes.replaceChildren(...found.flatMap((one, i) => {
      const d = `M${at[i].join(" ")}h0`, dot = svgElement("path", `dot ${one.look}`, { d, "stroke-width": size, "data-row": i });
      dot.dataset.tell = tellOf(one);
      return [dot, svgElement("path", `dot centre ${one.look}`, { d, "stroke-width": 0.45 * size })];
    }));
    layers.names.replaceChildren(...stationNames, ...found.map((one, i) => {
      const label = svgElement("text", "mark off", { x: at[i][0], y: at[i][1] });
      label.textContent = one.name;
      return label;
    }));
    const numbers = new Map();
    for (const one of found) numbers.set(one.status, (numbers.get(one.status) ?? 0) + 1);
    counted.textContent = found.length ? `Last minute: ${[...numbers].map(([status, n]) => `${n} ${status}`).join(", ")}.` : "No fix in the last minute.";
    // Keep the focus and the selection while the rows are replaced.
    const focused = document.activeElement?.closest?.(".list li")?.dataset.name, kind = document.activeElement?.className;
    picked = items.querySelector(".picked")?.dataset.name ?? null;
    items.replaceChildren(...found.map((one, i) => rowOf(one, i, at[i])));
    const rows = [...items.children], row = name => rows.find(each => each.dataset.name === name);
    if (rows.length) list.reachable(row(focused) ?? row(picked) ?? rows[0]);
    if (picked !== null) list.pick(row(picked) ?? null, { move: false });
    if (focused !== undefined) row(focused)?.querySelector(`.${kind || "pick"}`)?.focus();
    show();
  };
  const clock = seconds => new Date(seconds * 1000).toLocaleTimeString();
  const say = (kind, text) => {
    state.dataset.state = kind;
    if (state.textContent !== text) state.textContent = text;
  };
  const ask = async () => {
    try {
      const answer = await fetch(data.live, { cache: "no-store", signal: AbortSignal.timeout(patience) });
      if (!answer.ok) throw new Error(answer.status);
      const found = await answer.json();
      lostSince = null;
      last = found.last === null ? "no event yet" : `last event ${clock(found.last)}`;
      say("on", `Connected, ${last}`);
      // Draw only if something has changed, so that a reader can select texts.
      const now = JSON.stringify(found.fixes);
      if (now !== signature) {
        signature = now;
        draw(found.fixes.map(one => ({ ...one, seen: clock(one.received) })));
      }
    } catch {
      lostSince ??= Date.now() / 1000;
      say("off", `Reconnecting since ${clock(lostSince)}${last ? `, ${last}` : ""}. The page tries again every second.`);
    }
    setTimeout(ask, period);
  };
  ask();
};

for (const one of openMaps) if (one.data.live) openLive(one);
