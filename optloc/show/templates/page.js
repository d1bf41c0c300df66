// A click on a method in the legend highlights its lines in every figure.
(() => {
  const picked = new Set();
  for (const button of document.querySelectorAll(".legend button")) {
    button.addEventListener("click", () => {
      const name = button.dataset.method;
      picked.has(name) ? picked.delete(name) : picked.add(name);
      document.body.classList.toggle("picked", picked.size > 0);
      for (const other of document.querySelectorAll(".legend button"))
        other.setAttribute("aria-pressed", picked.has(other.dataset.method));
      for (const line of document.querySelectorAll('[class^="method-"]'))
        line.classList.toggle("chosen", picked.has(line.classList[0]));
    });
  }
  const fold = open => document.querySelectorAll("details").forEach(part => { part.open = open; });
  addEventListener("beforeprint", () => fold(true));
  addEventListener("afterprint", () => fold(false));
})();
