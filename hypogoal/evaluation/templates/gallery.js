// Shows the states of the gallery that its filters let through; without a script all are shown.
(() => {
  "use strict";
  const bar = document.querySelector(".filters");
  if (!bar) return;
  const filters = [...bar.querySelectorAll("select")];
  const states = [...document.querySelectorAll(".gallery li")];
  const count = bar.querySelector("[role=status]");
  const passes = (state) => filters.every((filter) => !filter.value || state.dataset[filter.dataset.filter] === filter.value);
  const show = () => {
    for (const state of states) state.hidden = !passes(state);
    count.textContent = `${states.filter(passes).length} of ${states.length} states`;
  };
  for (const filter of filters) filter.addEventListener("change", show);
  bar.hidden = false;
  show();
})();
