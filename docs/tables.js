// On a narrow screen each row of a table is a card (site.css), and each cell says which column it is of. Roles are given,
// because a browser forgets that cells which are blocks belong to a table.
for (const table of document.querySelectorAll(".md-typeset table:not([class])")) {
  const titles = [...table.querySelectorAll("thead th")].map((title) => title.textContent.trim());
  table.dataset.cards = "";
  table.setAttribute("role", "table");
  for (const row of table.querySelectorAll("tbody tr")) {
    row.setAttribute("role", "row");
    [...row.cells].forEach((cell, column) => {
      cell.setAttribute("role", "cell");
      cell.dataset.title = titles[column] ?? "";
    });
  }
}
