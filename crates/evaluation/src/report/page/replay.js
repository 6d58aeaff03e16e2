// The replay: one episode of one scenario, and its controls.

caudata.Replay = class extends caudata.Scene {
  // `onFrame` is told the frame whenever it changes.
  constructor(robot, footNames, onFrame) {
    super(robot, footNames);
    this.onFrame = onFrame;
    this.$("play").onclick = () => this.play(!this.playing);
    this.$("scrub").oninput = () => { this.play(false); this.seek(Number(this.$("scrub").value)); };
    document.addEventListener("keydown", (e) => {
      if (e.target.closest("input, select, button, a")) return;
      if (e.key === " ") { e.preventDefault(); this.play(!this.playing); }
      const step = { ArrowLeft: -1, ArrowRight: 1 }[e.key];
      if (step && e.target === this.$("view")) { e.preventDefault(); this.play(false); this.seek(Math.round(this.frame) + step * (e.shiftKey ? 10 : 1)); }
    });
  }

  open(film) {
    super.open(film);
    this.$("scrub").max = film ? film.frames - 1 : 1;
    this.seek(0);
  }

  seek(frame) {
    if (!this.film) return;
    this.frame = Math.max(0, Math.min(frame, this.film.frames - 1));
    this.$("scrub").value = Math.round(this.frame);
    const s = (f) => (f * this.film.period).toFixed(2);
    this.$("clock").textContent = `${s(Math.round(this.frame))} / ${s(this.film.frames - 1)} s`;
    this.dirty = true;
    this.onFrame(Math.round(this.frame), this.playing);
  }

  play(on) {
    if (on && this.film && this.frame >= this.film.frames - 1) this.seek(0);
    this.playing = on;
    if (!on && this.film) this.onFrame(Math.round(this.frame), false);
    this.$("play").textContent = on ? "Pause" : "Play";
  }

  tick(passed) {
    if (this.playing) {
      this.seek(this.frame + passed * Number(this.$("speed").value) / this.film.period);
      if (this.frame >= this.film.frames - 1) this.play(false);
    }
    super.tick();
  }
};
