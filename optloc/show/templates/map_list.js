// The list beside a map: selection of a mark, and buttons that copy coordinates. `api` moves the map and shows a text.

const copyText = async text => {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    // Without the permission, or in a page without https: copy from a field.
    const field = document.createElement("textarea");
    field.value = text;
    field.style.position = "fixed";
    document.body.append(field);
    field.select();
    const done = document.execCommand("copy");
    field.remove();
    return done;
  }
};

const listOf = (map, api) => {
  const list = map.querySelector(".list"), sheet = map.querySelector(".sheet"), chosen = sheet.querySelector(".chosen");
  const rows = () => list ? [...list.querySelectorAll("li")] : [];
  // One row at a time is in the order of the Tab key; arrows move to other rows.
  const reachable = row => {
    for (const each of list.querySelectorAll("button")) each.tabIndex = row.contains(each) ? 0 : -1;
  };
  const ring = at => chosen.setAttribute("d", at ? `M${at[0]} ${at[1]}h0` : "");
  const placeOf = row => row?.dataset.at?.split(" ").map(Number) ?? null;
  const textOf = row => [...row.querySelectorAll(".pick, code, .size")].map(part => part.textContent.trim().replace(/\s+/g, " ")).filter(Boolean).join(", ");
  const pick = (row, { move = true } = {}) => {
    for (const each of rows()) {
      each.classList.toggle("picked", each === row);
      each.querySelector(".pick").setAttribute("aria-pressed", each === row);
    }
    if (!row) { ring(null); return; }
    reachable(row);
    const at = placeOf(row);
    ring(at);
    if (at && move) api.reveal(at);
    api.tell(textOf(row));
  };
  // Scroll the list, but not the page.
  const scrollTo = row => {
    const box = list.scrollHeight > list.clientHeight + 1 ? list : map.querySelector(".side");
    const inner = row.getBoundingClientRect(), outer = box.getBoundingClientRect();
    if (box.scrollHeight > box.clientHeight + 1 && (inner.top < outer.top || inner.bottom > outer.bottom))
      box.scrollTop += inner.top - outer.top - outer.height / 3;
  };
  const pickNumber = number => {
    const row = list?.querySelector(`li[data-row="${number}"]`);
    if (!row) return false;
    pick(row, { move: false });
    scrollTo(row);
    return true;
  };
  // Select the mark nearest to a point of the drawing.
  const pickNearest = ([x, y]) => {
    const far = row => { const at = placeOf(row); return at ? Math.hypot(at[0] - x, at[1] - y) : Infinity; };
    const best = rows().reduce((a, b) => (a && far(a) <= far(b) ? a : b), null);
    if (best && far(best) < Infinity) { pick(best, { move: false }); scrollTo(best); }
  };
  list?.addEventListener("click", async event => {
    const button = event.target.closest("button"), row = event.target.closest("li");
    if (button?.classList.contains("pick")) pick(row);
    if (button?.classList.contains("copy")) {
      const done = await copyText(button.dataset.copy);
      button.textContent = done ? "Copied" : "Select it";
      api.tell(done ? `Copied: ${button.dataset.copy}` : "The browser does not permit copying. Select the coordinates and copy them.");
      setTimeout(() => { button.textContent = "Copy"; }, 1500);
    }
  });
  list?.addEventListener("keydown", event => {
    const all = rows(), at = all.indexOf(event.target.closest("li"));
    const next = { ArrowDown: at + 1, ArrowUp: at - 1, Home: 0, End: all.length - 1 }[event.key];
    if (next === undefined || !all[next]) return;
    event.preventDefault();
    reachable(all[next]);
    all[next].querySelector(".pick").focus();
  });
  if (rows().length) reachable(rows()[0]);
  return { pick, pickNumber, pickNearest, ring, reachable };
};
