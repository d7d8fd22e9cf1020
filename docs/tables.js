// On a narrow screen each row of a table is a card (site.css), and each cell says which column it is of.
for (const table of document.querySelectorAll(".md-typeset table:not([class])")) {
  const titles = [...table.querySelectorAll("thead th")].map((title) => title.textContent.trim());
  table.dataset.cards = "";
  for (const row of table.querySelectorAll("tbody tr")) {
    [...row.cells].forEach((cell, column) => { cell.dataset.title = titles[column] ?? ""; });
  }
}
