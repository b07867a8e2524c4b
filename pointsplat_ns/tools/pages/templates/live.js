// The stage of the viewer: pointsplat view gives it scenes, at the share of the Gaussians that a slider says.

const DAMAGED = "The scene came damaged";
const REST = 600; // milliseconds until a share counts as chosen: then its Gaussians are merged
const WATCH = 2000; // milliseconds between two looks at the files of the scenes
const ENDED = "The viewer does not answer. Has pointsplat view ended?";

class Live extends Flight {
  async load() {
    this.kept = [...this.data.kept];
    this.changes = this.kept.map(() => 0); // of each slider
    this.asking = 0;
    this.whole = [];
    this.root = this.part.stage.parentElement;
    this.start();
    this.watch();
    for (let index = 0; index < this.kept.length; index++) {
      this.say(`Loading ${this.data.scenes[index].name} …`);
      const { state, spz } = await this.ask(index, "");
      this.whole.push(await this.unpacked(spz, DAMAGED));
      this.describe(index, state);
    }
    this.shown = [...this.whole];
    this.scenes = [...this.whole];
  }

  listen() {
    super.listen();
    this.root.querySelectorAll("[data-kept]").forEach((slider, index) => {
      slider.addEventListener("input", () => this.keep(index, Number(slider.value)));
    });
    this.compare();
  }

  // Show a scene at a share of its Gaussians: what is chosen at once, and then what is merged.
  async keep(index, percent) {
    const change = ++this.changes[index], isNewest = () => change === this.changes[index];
    this.kept[index] = percent;
    this.root.querySelectorAll(".kept output")[index].textContent = `${percent} %`;
    this.asking += 1;
    try {
      for (let have = "", isWhole = false; !isWhole; ) {
        await new Promise((done) => setTimeout(done, have ? REST : REST / 6));
        if (!isNewest()) return;
        const { state, spz } = await this.ask(index, have);
        if (have !== state.how) {
          const scene = percent === 100 ? this.whole[index] : await this.unpacked(spz, DAMAGED);
          if (isNewest()) this.put(index, scene);
          else this.leave(index, scene);
        }
        if (!isNewest()) return;
        this.describe(index, state);
        [have, isWhole] = [state.how, state.whole];
      }
    } catch (error) {
      if (isNewest()) this.describe(index, { amount: error.message, command: "" });
    } finally {
      this.asking -= 1;
    }
  }

  // Less than all of the only scene is compared with all of it.
  put(index, scene) {
    const before = this.shown[index];
    this.shown[index] = scene;
    this.scenes = this.kept.length > 1 || scene === this.whole[0] ? [...this.shown] : [scene, this.whole[0]];
    this.leave(index, before);
    this.compare();
    this.change();
  }

  leave(index, scene) {
    if (scene === this.shown[index] || scene === this.whole[index]) return;
    scene.sorting.end();
    this.drawer.remove(scene);
  }

  compare() {
    const parts = [this.part.wipe, this.part.stage.querySelector(".flight-name.right")];
    for (const part of parts) part.hidden = this.scenes.length < 2;
  }

  describe(index, { amount, command }) {
    const code = this.root.querySelectorAll(".kept code")[index];
    this.part.stage.querySelectorAll(".flight-name span")[index].textContent = amount;
    code.textContent = command;
    code.hidden = !command;
  }

  // Say that the file of a scene has changed or is gone, or that the viewer has ended.
  async watch() {
    const note = document.getElementById("changed");
    for (;;) {
      await new Promise((done) => setTimeout(done, WATCH));
      if (document.hidden) continue;
      const answer = await fetch("/watch").then((found) => found.json()).catch(() => ({ stage: this.data.stage, notes: [ENDED] }));
      if (answer.stage !== this.data.stage) return location.reload(); // another scene is shown by now
      const text = answer.notes.join(" ");
      if (note.textContent !== text) note.textContent = text;
      note.hidden = !text;
    }
  }

  get still() {
    return super.still && !this.asking;
  }

  async ask(index, have) {
    const percent = this.kept[index], isHere = percent === 100 && this.whole[index];
    const body = JSON.stringify({ stage: this.data.stage, scene: index, percent, have, spz: !isHere });
    const answer = await fetch("/scene", { method: "POST", body }).catch(() => ({ ok: false }));
    if (answer.status === 409) location.reload(); // another scene is shown by now
    if (!answer.ok) throw new Error(ENDED);
    return { state: JSON.parse(answer.headers.get("X-State")), spz: new Uint8Array(await answer.arrayBuffer()) };
  }
}
