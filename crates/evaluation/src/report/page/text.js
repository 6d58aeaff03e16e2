// Elements and numbers. Everything goes in as text, never as markup.

caudata.el = (tag, attributes = {}, ...children) => {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (value !== undefined && value !== false) node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.filter((c) => c !== null && c !== undefined));
  return node;
};

caudata.number = (x, digits = 2) => (x === null || x === undefined || !Number.isFinite(x) ? "–" : x.toFixed(digits).replace("-", "−"));
caudata.estimate = (e, digits = 3) => (e ? `${caudata.number(e.mean, digits)} ± ${caudata.number((e.ci_high - e.ci_low) / 2, digits)}` : "–");
caudata.percent = (x, digits = 1) => (x === null || x === undefined ? "–" : `${caudata.number(100 * x, digits)} %`);

caudata.table = (heads, rows) => {
  const { el } = caudata;
  const cell = (value) => (value instanceof Node && value.tagName === "TD" ? value : el("td", {}, value));
  return el("div", { class: "scroll" }, el("table", {},
    el("thead", {}, el("tr", {}, ...heads.map((h) => el("th", { scope: "col" }, h)))),
    el("tbody", {}, ...rows.map((row) => el("tr", {}, ...row.map(cell))))));
};
