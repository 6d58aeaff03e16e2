// What may change in a training: a form with the present values, and the changes that were made.

caudata.Settings = class {
  static GROUPS = [["Reward weights", /^task\.reward\.(weights\.)?/], ["Learning", /^learner\.ppo\./], ["Commands", /^task\.command\./], ["Randomisation", /^task\.randomisation\./]];
  static SHOWN = 12;

  // `change`: the token for changes, empty where one may only look.
  constructor(token, change) {
    this.headers = { "x-caudata-token": token, "x-caudata-change": change };
    this.may = change !== "";
    this.inputs = new Map();
    this.sent = new Map();
    const $ = (id) => document.getElementById(`settings-${id}`);
    this.$ = $;
    $("form").onsubmit = (e) => { e.preventDefault(); this.send(); };
    $("form").oninput = () => this.mark();
    $("undo").onclick = () => { for (const [input, value] of this.inputs.values()) input.value = value; this.said(""); this.mark(); };
    $("send").hidden = $("undo").hidden = !this.may;
  }

  said(text, kind = "") { this.$("said").textContent = text; this.$("said").className = `small ${kind}`; }

  build(values) {
    const { el } = caudata, { GROUPS } = caudata.Settings;
    const group = ([title, prefix], i) => {
      const rows = values.filter(([key]) => prefix.test(key)).map(([key, value]) => {
        const input = el("input", { type: "text", spellcheck: false, autocomplete: "off", readOnly: !this.may, value });
        this.inputs.set(key, [input, value]);
        return el("label", { title: key }, el("span", {}, key.replace(prefix, "")), input);
      });
      return el("details", { open: i < 2 }, el("summary", {}, title), el("div", { class: "settings" }, ...rows));
    };
    this.$("groups").replaceChildren(...GROUPS.map(group));
    document.getElementById("settings").hidden = false;
    this.$("about").textContent = this.may ? "They change between two iterations, are checked like the configuration, and stay in the run folder (changes.toml)."
      : "To change them, open the other address that the terminal has printed.";
  }

  show({ values, made }) {
    if (values.length !== this.inputs.size) { this.inputs.clear(); this.build(values); }
    for (const [key, value] of values) {
      const entry = this.inputs.get(key);
      // What somebody is about to change is left alone; what was sent comes back as it is written here.
      const sent = this.sent.get(key) === entry[0].value.trim() && value !== entry[1];
      if (sent || entry[0].value === entry[1]) entry[0].value = value;
      entry[1] = value;
    }
    const newest = JSON.stringify(made.at(-1) || null);
    if (made.length && this.newest && this.newest !== newest) this.said(`changed after iteration ${made.at(-1).iteration}`, "good");
    this.newest = newest;
    const shown = made.slice(-caudata.Settings.SHOWN).reverse();
    this.$("made").replaceChildren(...shown.map(({ iteration, set }) => caudata.el("li", {}, `after iteration ${iteration}: ${set.join(", ")}`)));
    this.mark();
  }

  differing() { return [...this.inputs].filter(([, [input, value]]) => input.value.trim() !== value); }

  mark() {
    const differing = this.differing();
    for (const [input, value] of this.inputs.values()) input.classList.toggle("differs", input.value.trim() !== value);
    this.$("send").disabled = this.$("undo").disabled = !differing.length;
  }

  async send() {
    this.sent = new Map(this.differing().map(([key, [input]]) => [key, input.value.trim()]));
    const set = [...this.sent].map(([key, value]) => `${key}=${value}`);
    this.said("asked for; it waits for the end of an iteration");
    try {
      const answer = await fetch("change", { method: "POST", headers: this.headers, body: JSON.stringify(set) });
      if (!answer.ok) this.said((await answer.text()).trim(), "bad");
    } catch {
      this.said("the change did not arrive", "bad");
    }
  }
};
