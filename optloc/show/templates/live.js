"use strict";
// Request the latest fixes from the server of this page once a second, and draw them like fixes on other maps.
{
  const map = document.querySelector(".map"), data = JSON.parse(map.querySelector("script").textContent);
  const layer = map.querySelector('[data-layer="fixes"]'), note = document.querySelector("p.soft"), text = note.textContent;
  const mark = ({ geometry, properties }) => {
    const [lon, lat] = geometry.coordinates, turned = ((lon - data.middle[0] + 540) % 360) - 180;
    const x = turned * data.scale[0], y = (lat - data.middle[1]) * data.scale[1];
    const dot = document.createElementNS("http://www.w3.org/2000/svg", "path");
    dot.setAttribute("class", "dot");
    dot.setAttribute("d", `M${x} ${y}h0`);
    dot.setAttribute("stroke", properties.status === "ok" ? "#0072b2" : "#d55e00");
    dot.setAttribute("stroke-width", 9);
    dot.dataset.tell = [properties.target ?? properties.event, properties.status, `${lat.toFixed(5)}°, ${lon.toFixed(5)}°`].join(", ");
    return dot;
  };
  const ask = async () => {
    try {
      const found = await (await fetch("fixes.geojson", { cache: "no-store" })).json();
      layer.replaceChildren(...found.features.filter(one => one.geometry).map(mark));
      note.textContent = text;
    } catch {
      note.textContent = "The server does not answer. The page tries again every second.";
    }
    setTimeout(ask, 1000);
  };
  ask();
}
