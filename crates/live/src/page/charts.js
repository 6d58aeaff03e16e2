// The charts of the live page: velocities of the last seconds, and what training has come to.

caudata.Trace = class {
  static WINDOW_S = 10;
  static MEAN_S = 0.7;
  static EVERY_MS = 100;

  constructor() {
    this.sheet = new caudata.Sheet(document.getElementById("plot-trace"));
  }

  // Draws the film up to its newest row, a few times a second.
  draw(film, now) {
    if (!film.frames || now - (this.last || 0) < caudata.Trace.EVERY_MS) return;
    this.last = now;
    const { WINDOW_S, MEAN_S } = caudata.Trace, { period } = film;
    const newest = film.frames - 1, first = Math.max(0, newest - Math.round(WINDOW_S / period));
    const half = Math.round(MEAN_S / period / 2);
    const rows = Array.from({ length: newest - first + 1 }, (_, i) => first + i);
    const xs = rows.map((r) => (r - newest) * period);
    const sheet = this.sheet.begin(), { theme, width, height } = sheet;
    const names = ["forward, m/s", "to the left, m/s", "yaw rate, rad/s"], top = 22, gap = 12, each = (height - top - 40 - 2 * gap) / 3;
    names.forEach((name, i) => {
      const command = rows.map((r) => film.command(r)[i]), achieved = rows.map((r) => film.achieved(r)[i]);
      const mean = achieved.map((_, k) => {
        const near = achieved.slice(Math.max(0, k - half), k + half + 1);
        return near.reduce((a, b) => a + b, 0) / near.length;
      });
      const y0 = top + i * (each + gap);
      const axes = sheet.axes({ box: [62, y0, width - 10, y0 + each], x: [-WINDOW_S, 0], y: caudata.range([command, mean, [0]], 0.3), xTicks: 10, yTicks: 3, xText: i === 2, xLabel: i === 2 ? "time, s" : "" });
      sheet.line(axes, xs, achieved, theme.band, 1);
      sheet.line(axes, xs, command, theme.command, 1.5, [5, 4]);
      sheet.line(axes, xs, mean, theme.accent, 2);
      sheet.text(name, width - 16, y0 + 11, { align: "right", color: theme.soft });
    });
    sheet.key([{ label: "commanded", color: theme.command, dash: [5, 4] }, { label: "achieved", color: theme.accent }], 62, 9);
  }
};

caudata.Training = class {
  // Most points of a curve; of more, every second one is kept.
  static POINTS = 1024;

  constructor() {
    this.points = [];
    this.marks = [];
    this.hidden = new Set();
    this.other = [];
    for (const name of ["return", "terms"]) this[name] = new caudata.Sheet(document.getElementById(`plot-${name}`));
  }

  restore(points) { this.points = points; this.show(); }

  add(point) {
    this.points.push(point);
    if (this.points.length > caudata.Training.POINTS) this.points = this.points.filter((_, i, all) => i % 2 === 1 || i === all.length - 1);
    this.show();
  }

  // Where settings changed.
  mark(made) { this.marks = made.map(({ iteration }) => iteration); this.show(); }

  // The curve of another run, [environment steps, return] each: drawn where this run has done as many.
  beside(curve) { this.other = (curve || []).filter(([, value]) => value !== null); this.show(); }

  show() {
    const last = this.points.at(-1);
    if (!last) return;
    document.getElementById("training").hidden = false;
    this.figures(last);
    this.curve();
    this.curves(last);
  }

  figures(last) {
    const { el, number } = caudata;
    const clock = (s) => (Number.isFinite(s) ? `${Math.floor(s / 60)}:${String(Math.round(s) % 60).padStart(2, "0")}` : "–");
    const account = last.accounting;
    const shown = [
      [`${last.iteration} / ${last.iterations}`, "iterations"], [clock(last.eta_s), "left"], [Math.round(last.steps_per_s).toLocaleString("en"), "steps per second"],
      [number(last.mean_return), "return"], [number(last.mean_episode_length, 0), "steps per episode"], [number(last.kl, 4), "KL, nats"], [number(last.lag_mean, 1), "policies of lag"],
      [`${account.accepted} / ${account.rejected} / ${account.dropped}`, "chunks used / refused / dropped"],
    ];
    document.getElementById("figures").replaceChildren(...shown.map(([value, label]) => el("div", { class: "card" }, el("b", {}, value), el("span", {}, label))));
  }

  axes(sheet, values, until = 0) {
    const xs = this.points.map((p) => p.iteration);
    const { width, height } = sheet.begin();
    const axes = sheet.axes({ box: [62, 8, width - 10, height - 38], x: [xs[0], Math.max(xs.at(-1), xs[0] + 1, until)], y: caudata.range(values, 0.1), xTicks: 5, yTicks: 5, xLabel: "iteration" });
    for (const at of this.marks) sheet.line(axes, [at, at], axes.y, sheet.theme.command, 1, [2, 3]);
    return [axes, xs];
  }

  curve() {
    const values = this.points.map((p) => p.mean_return ?? NaN);
    const from = values.findIndex(Number.isFinite);
    if (from < 0) return this.return.empty("no episode has ended yet");
    const last = this.points.at(-1), each = last.iteration / last.steps_total;
    const beside = this.other.map(([steps, value]) => [steps * each, value]).filter(([at]) => at >= this.points[0].iteration);
    const other = [0, 1].map((i) => beside.map((point) => point[i]));
    const [axes, xs] = this.axes(this.return, [values, other[1]], other[0].at(-1));
    this.return.line(axes, ...other, this.return.theme.command, 1.5, [5, 4]);
    return this.return.line(axes, xs.slice(from), values.slice(from), this.return.theme.accent, 2);
  }

  // Colours that stay with a term, however many there are.
  color(index) { return `hsl(${(index * 137.5) % 360} 62% ${this.terms.theme.dark ? 66 : 42}%)`; }

  curves(last) {
    const names = Object.keys(last.reward_terms).filter((name) => this.points.some((p) => p.reward_terms[name]));
    const values = names.map((name) => this.points.map((p) => p.reward_terms[name] ?? NaN));
    const shown = names.map((name) => !this.hidden.has(name));
    const [axes, xs] = this.axes(this.terms, values.filter((_, i) => shown[i]));
    values.forEach((ys, i) => {
      const from = ys.findIndex(Number.isFinite);
      if (shown[i] && from >= 0) this.terms.line(axes, xs.slice(from), ys.slice(from), this.color(i), 1.6);
    });
    const key = names.map((name, i) => {
      const toggle = () => { shown[i] ? this.hidden.add(name) : this.hidden.delete(name); this.show(); };
      return caudata.el("button", { type: "button", "aria-pressed": shown[i], onclick: toggle }, caudata.el("i", { style: `background: ${shown[i] ? this.color(i) : "transparent"}` }), `${name} ${caudata.number(values[i].at(-1))}`);
    });
    document.getElementById("terms").replaceChildren(...key);
  }
};
