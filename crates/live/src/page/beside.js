// A training beside another run: its return over this one's, what the evaluations found, the settings that differ.

caudata.Beside = class {
  // `show`: what draws the other's curve, [environment steps, return] each, and nothing for null.
  constructor(token, show) {
    this.token = token;
    this.show = show;
    this.$ = (id) => document.getElementById(`beside-${id}`);
    this.$("run").onchange = () => this.choose(this.$("run").value);
  }

  async ask(run) {
    const answer = await fetch("beside", { method: "POST", headers: { "x-caudata-token": this.token }, body: JSON.stringify(run) });
    if (!answer.ok) throw new Error((await answer.text()).trim());
    return answer.json();
  }

  // The runs that there are by now; the chosen one stays.
  async list() {
    const chosen = this.$("run").value, option = (value, text) => caudata.el("option", { value, selected: value === chosen }, text);
    try {
      const names = await this.ask(null);
      this.$("run").replaceChildren(option("", names.length ? "no other run" : "there is no other run here"), ...names.map((name) => option(name, name)));
    } catch (error) { this.$("said").textContent = error.message; }
  }

  async choose(run) {
    this.$("said").textContent = "";
    this.$("table").replaceChildren();
    if (!run) return this.show(null);
    try {
      const found = await this.ask(run);
      this.show(found.curve);
      this.table(found);
    } catch (error) {
      this.show(null);
      this.$("said").textContent = error.message;
    }
  }

  table({ runs, gates_missed, settings }) {
    const { el, number } = caudata;
    const figure = (label, key, digits) => [label, ...runs.map((run) => (run[key] === null ? "–" : number(run[key], digits)))];
    const gates = gates_missed.map((missed) => (missed === null ? "–" : missed.join("; ") || "none"));
    const rows = [["", ...runs.map((run) => run.run)], figure("iterations", "iteration", 0), figure("return", "episode_return"), figure("forward, m/s", "forward_mps", 3),
      figure("power, W", "power_w"), figure("falls", "fall_share", 3), ["gates missed", ...gates], ...settings.map(({ key, values }) => [key, ...values])];
    const row = (cells, i) => el("tr", {}, ...cells.map((cell) => el(i ? "td" : "th", {}, cell)));
    this.$("table").replaceChildren(el("table", {}, ...rows.map(row)));
  }
};
