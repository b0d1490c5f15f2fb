"use strict";

// Tables: a click on a heading sorts by its column, another one turns the order.
const number = (text) => parseFloat(text.replace(/,/g, "").replace(/^\+/, ""));
function compare(one, other, sign) {
  const [a, b] = [number(one), number(other)];
  if (!isNaN(a) && !isNaN(b)) return sign * (a - b);
  if (isNaN(a) !== isNaN(b)) return isNaN(a) ? 1 : -1; // what is no number comes last, whichever way
  return sign * one.localeCompare(other, "en", { numeric: true });
}
for (const table of document.querySelectorAll("table.sorts")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      heads.forEach((one) => one.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const text = (row) => row.cells[column].textContent.trim();
      const rows = [...table.tBodies[0].rows].sort((one, other) => compare(text(one), text(other), up ? 1 : -1));
      table.tBodies[0].append(...rows);
    });
  });
}

// What is folded is printed too.
addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((one) => (one.open = true)));

// Replays: the viewer's page around the recording that was chosen, in a frame of its own.
const dark = matchMedia("(prefers-color-scheme: dark)");
for (const script of document.querySelectorAll("script.replays")) {
  const { before, after, replays } = JSON.parse(script.textContent);
  const stage = script.parentElement.querySelector(".stage");
  const [who, where, outcome, viewer] = ["who", "where", "outcome", "viewer"].map((name) => stage.querySelector("." + name));
  const fill = (select, words) => {
    const old = select.value;
    select.replaceChildren(...[...new Set(words)].map((word) => new Option(word)));
    if (words.includes(old)) select.value = old;
  };
  const show = () => {
    fill(where, replays.filter((one) => one.who === who.value).map((one) => one.where));
    const chosen = replays.find((one) => one.who === who.value && one.where === where.value);
    outcome.textContent = chosen.outcome;
    const frame = document.createElement("iframe");
    frame.title = `Replay: ${chosen.who}, ${chosen.where}`;
    frame.setAttribute("sandbox", "allow-scripts");
    frame.srcdoc = before + chosen.data + after.replace("darkMode:false", `darkMode:${dark.matches}`);
    viewer.replaceChildren(frame);
  };
  fill(who, replays.map((one) => one.who));
  stage.hidden = false;
  [who, where].forEach((select) => select.addEventListener("change", show));
  // The frame is heavy: it begins when it is about to be seen.
  const seen = new IntersectionObserver((entries) => {
    if (!entries.some((entry) => entry.isIntersecting)) return;
    seen.disconnect();
    show();
    dark.addEventListener("change", show);
  });
  seen.observe(viewer);
}
