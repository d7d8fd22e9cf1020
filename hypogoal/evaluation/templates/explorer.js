/* Browses the states of the page (see hypogoal/evaluation/explorer.py). The address holds what is shown. */
(() => {
  "use strict";
  const root = document.getElementById("explorer-app");
  const goals = JSON.parse(document.getElementById("explorer-data").textContent).goals;
  const at = (name) => document.getElementById("explorer-" + name);
  const FILTERS = ["goal", "truth", "members", "errors", "place", "kind"];
  const filters = FILTERS.map(at).filter(Boolean);
  const nameOf = (select) => select.id.replace("explorer-", "");
  let state = null; // the chosen state's place in its sub-goal's list
  let member = 0;

  const make = (tag, attributes = {}, ...children) => {
    const node = document.createElement(tag);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    node.append(...children);
    return node;
  };
  const image = (png, alt) => make("img", { src: "data:image/png;base64," + png, alt });
  const labelOf = (positive) => (positive ? "positive" : "negative");
  const goal = () => goals[at("goal").selectedIndex];
  const errorsOf = (one) => one.says.filter((said) => said !== one.truth).length;

  const PASSES = {
    truth: (one, wanted) => labelOf(one.truth) === wanted,
    members: (one, wanted) => (new Set(one.says).size > 1) === (wanted === "disagree"),
    errors: (one, wanted) => {
      const wrong = errorsOf(one);
      if (wanted === "none") return wrong === 0;
      if (wanted === "some") return wrong > 0;
      if (wanted === "all") return wrong === one.says.length;
      return one.says[Number(wanted)] !== one.truth; // a member's number
    },
    place: (one, wanted) => one.place === wanted,
    kind: (one, wanted) => one.kind === wanted,
  };
  const passes = (one) =>
    filters.every((select) => nameOf(select) === "goal" || !select.value || PASSES[nameOf(select)](one, select.value));

  const verdict = (one, index) => {
    const wrong = one.says[index] !== one.truth;
    return make("span", { class: wrong ? "wrong" : labelOf(one.says[index]) }, labelOf(one.says[index]) + (wrong ? " ✗" : ""));
  };
  const said = (one, index) => make("span", {}, make("small", {}, make("span", { class: "heard" }, "member "), `${index} `), verdict(one, index));

  const tile = (one, index) => {
    const where = [one.place, one.kind].filter(Boolean).join(", ");
    const button = make(
      "button",
      {
        type: "button",
        class: "tile",
        "data-state": index,
        "aria-pressed": index === state,
      },
      image(one.png, `State ${index}, ${where}:`),
      make("span", {}, "truth " + labelOf(one.truth)),
      make("span", { class: "says" }, ...one.says.map((_, k) => said(one, k))),
    );
    button.addEventListener("click", () => {
      state = index;
      draw();
      at("tiles").querySelector(`[data-state="${index}"]`).focus();
    });
    return make("li", {}, button);
  };

  const card = (picture, ...lines) => make("div", { class: "card" }, picture, ...lines);
  const soft = (text) => make("div", { class: "soft" }, text);

  const detail = () => {
    const one = goal().states[state];
    if (!one) return [];
    const where = [one.place, one.kind].filter(Boolean).join(", ");
    const heading = make("h3", { tabindex: "-1" }, `State ${state}`);
    const cards = [card(image(one.png, `State ${state}`), make("div", {}, `truth: ${labelOf(one.truth)}`), soft(where))];
    one.says.forEach((said, k) => {
      const drawn = one.saliency.length
        ? image(one.saliency[k], `Attributions of member ${k}`)
        : make("div", { class: "nothing" }, "no attributions kept for this state");
      const choose = make("button", { type: "button", "aria-pressed": k === member }, `member ${k}`);
      choose.addEventListener("click", () => {
        member = k;
        draw();
        at("member").querySelector("h3").focus();
      });
      cards.push(card(drawn, choose, make("div", {}, verdict(one, k), ` ${one.p[k].toFixed(2)}`)));
    });
    return [heading, make("div", { class: "cards" }, ...cards)];
  };

  const facts = (rows) => make("dl", {}, ...rows.flatMap(([key, value]) => [make("dt", {}, key), make("dd", {}, value)]));

  const memberPanel = () => {
    const found = goal().members[member];
    const options = found.options.map((option) => {
      const drawn = option.png
        ? make("div", {}, image(option.png, `States in which it ends: ${option.name}`), soft(option.states))
        : make("div", { class: "nothing" }, "no state in which it ends");
      const body = make("div", {}, make("h4", {}, option.name), ...(option.note ? [soft(option.note)] : []), facts(option.facts));
      return make("div", { class: "option card" }, drawn, body);
    });
    const none = "No agent of this run was learned with this ensemble.";
    return [
      make("h3", { tabindex: "-1" }, `Member ${member} of ${goal().name}`),
      facts(found.facts),
      ...(options.length
        ? [make("p", {}, "Its options: the states in which they end, one whole and the others half transparent, and how they fared in training."), make("div", { class: "options" }, ...options)]
        : [make("p", { class: "soft" }, none)]),
    ];
  };

  const draw = (remember = true) => {
    const { states, members } = goal();
    member = Math.min(Math.max(member, 0), members.length - 1);
    const shown = states.map((one, index) => [one, index]).filter(([one]) => passes(one));
    if (!shown.some(([, index]) => index === state)) {
      const first = shown.find(([one]) => one.saliency.length) ?? shown[0]; // one with attributions says more
      state = first ? first[1] : null;
    }
    at("count").textContent = `${shown.length} of ${states.length} states`;
    at("tiles").replaceChildren(...shown.map(([one, index]) => tile(one, index)));
    at("detail").replaceChildren(...detail());
    at("member").replaceChildren(...memberPanel());
    if (remember) write();
  };

  const write = () => {
    const given = new URLSearchParams();
    for (const select of filters) if (select.selectedIndex > 0) given.set(nameOf(select), select.value);
    if (state !== null) given.set("state", state);
    given.set("member", member);
    history.replaceState(null, "", "#explorer?" + given);
  };

  const read = () => {
    const [place, query] = location.hash.slice(1).split("?");
    if (place !== "explorer" || query === undefined) return false;
    const given = new URLSearchParams(query);
    for (const select of filters) {
      const wanted = given.get(nameOf(select)) ?? "";
      const index = [...select.options].findIndex((option) => option.value === wanted);
      select.selectedIndex = Math.max(index, 0);
    }
    state = given.has("state") ? Number(given.get("state")) : null;
    member = Number(given.get("member") ?? 0) || 0;
    return true;
  };

  for (const select of filters) select.addEventListener("change", () => draw());
  at("reset").addEventListener("click", () => {
    for (const select of filters) if (nameOf(select) !== "goal") select.selectedIndex = 0;
    draw();
  });
  at("tiles").addEventListener("keydown", (event) => {
    const buttons = [...at("tiles").querySelectorAll("button")];
    const top = (button) => Math.round(button.getBoundingClientRect().top);
    const columns = buttons.filter((button) => top(button) === top(buttons[0])).length;
    const step = { ArrowRight: 1, ArrowLeft: -1, ArrowDown: columns, ArrowUp: -columns }[event.key];
    const next = buttons[buttons.indexOf(document.activeElement) + step];
    if (step) event.preventDefault();
    if (step && next) next.click();
  });
  addEventListener("hashchange", () => read() && draw(false));
  const linked = read();
  const apart = (one) => new Set(one.says).size > 1;
  if (!linked && goals.some((each) => each.states.some(apart))) {
    if (!goal().states.some(apart)) at("goal").selectedIndex = goals.findIndex((each) => each.states.some(apart));
    at("members").value = "disagree"; // what an ensemble is for; "clear" shows all
  }
  draw(false);
  root.hidden = false;
  if (linked) root.scrollIntoView();
})();
