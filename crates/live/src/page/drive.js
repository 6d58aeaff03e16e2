// What a person asks for: sliders, keys, a gamepad, clicks. Orders go out one after the other, the newest velocity in place of older ones.

caudata.Orders = class {
  static WAITING = 16;

  constructor(token, refused) {
    this.token = token;
    this.refused = refused;
    this.waiting = [];
    this.busy = false;
  }

  give(order) {
    if (order.do === "drive") this.waiting = this.waiting.filter((o) => o.do !== "drive");
    if (this.waiting.length >= caudata.Orders.WAITING) return;
    this.waiting.push(order);
    this.next();
  }

  async next() {
    if (this.busy || !this.waiting.length) return;
    this.busy = true;
    try {
      const answer = await fetch("order", { method: "POST", headers: { "x-caudata-token": this.token }, body: JSON.stringify(this.waiting.shift()) });
      if (!answer.ok) this.refused(await answer.text());
    } catch {
      this.refused("the order did not arrive");
    }
    this.busy = false;
    this.next();
  }
};

caudata.Drive = class {
  static IDS = ["vx", "vy", "yaw"];
  static UNITS = ["m/s", "m/s", "rad/s"];
  static KEYS = { w: [0, 1], arrowup: [0, 1], s: [0, -1], arrowdown: [0, -1], q: [1, 1], e: [1, -1], a: [2, 1], arrowleft: [2, 1], d: [2, -1], arrowright: [2, -1] };
  static DEAD = 0.15;

  // `ranges`: least and greatest of each velocity; `give` takes an order.
  constructor(ranges, give) {
    this.ranges = ranges;
    this.give = give;
    this.velocity = [0, 0, 0];
    this.held = new Set();
    this.padded = false;
    this.sliders = caudata.Drive.IDS.map((id) => document.getElementById(id));
    this.sliders.forEach((slider, i) => {
      [slider.min, slider.max] = ranges[i];
      slider.disabled = ranges[i][0] === ranges[i][1];
      slider.oninput = () => { const v = [...this.velocity]; v[i] = Number(slider.value); this.go(v); };
    });
    document.getElementById("halt").onclick = () => this.go([0, 0, 0]);
    document.getElementById("restart").onclick = () => give({ do: "restart" });
    document.addEventListener("keydown", (e) => this.key(e, true));
    document.addEventListener("keyup", (e) => this.key(e, false));
    window.addEventListener("blur", () => { if (this.held.size) { this.held.clear(); this.go([0, 0, 0]); } });
    this.show();
  }

  // A share of what is possible in that direction.
  part(i, share) { return share >= 0 ? share * this.ranges[i][1] : -share * this.ranges[i][0]; }

  key(e, down) {
    if (e.target.closest("input, select") || e.ctrlKey || e.metaKey || e.altKey) return;
    const key = e.key.toLowerCase();
    if (down && key === "r") { this.give({ do: "restart" }); return; }
    if (down && key === " " && !e.target.closest("button")) { e.preventDefault(); this.held.clear(); this.go([0, 0, 0]); return; }
    if (!caudata.Drive.KEYS[key]) return;
    e.preventDefault();
    if (down === this.held.has(key)) return;
    down ? this.held.add(key) : this.held.delete(key);
    const shares = [0, 0, 0];
    for (const k of this.held) { const [i, sign] = caudata.Drive.KEYS[k]; shares[i] += sign; }
    this.go(shares.map((share, i) => this.part(i, Math.max(-1, Math.min(share, 1)))));
  }

  // Left stick: walk; right stick: turn.
  pad() {
    const pad = navigator.getGamepads && [...navigator.getGamepads()].find((p) => p && p.connected);
    if (!pad) return;
    const axis = (i) => (Math.abs(pad.axes[i] || 0) < caudata.Drive.DEAD ? 0 : -pad.axes[i]);
    const shares = [axis(1), axis(0), axis(2)];
    const moved = shares.some((share) => share !== 0);
    if (moved || this.padded) this.go(shares.map((share, i) => Math.round(100 * this.part(i, share)) / 100));
    this.padded = moved;
  }

  go(velocity) {
    if (velocity.every((v, i) => v === this.velocity[i])) return;
    this.velocity = velocity;
    this.show();
    this.give({ do: "drive", velocity });
  }

  // What the robot was told, perhaps by somebody else.
  told(velocity) {
    if (this.held.size || this.padded || this.sliders.includes(document.activeElement)) return;
    this.velocity = [...velocity];
    this.show();
  }

  show() {
    this.sliders.forEach((slider, i) => {
      slider.value = this.velocity[i];
      slider.nextElementSibling.textContent = `${caudata.number(this.velocity[i])} ${caudata.Drive.UNITS[i]}`;
    });
  }
};
