// The stage of the viewer: pointsplat view gives it scenes, at the share of the Gaussians that a slider says, and draws
// pictures of them for browsers that cannot.

const REST = 600; // milliseconds until a share counts as chosen: then its Gaussians are merged
const QUICK = 360; // pixels of the longer side of a picture while the camera moves

class Live extends Flight {
  start() {
    let why;
    try {
      if (location.search !== "?pictures") return super.start();
    } catch (error) {
      why = error;
    }
    this.drawer = new Pictures(this.canvas, why, (values) => this.picture(values));
  }

  async load() {
    this.kept = [...this.data.kept];
    this.changes = this.kept.map(() => 0); // of each slider
    this.asking = 0;
    this.whole = [];
    this.root = this.part.stage.parentElement;
    this.start();
    for (let index = 0; index < this.kept.length; index++) {
      this.say(`Loading ${this.data.scenes[index].name} …`);
      const { state, spz } = await this.ask(index, "");
      this.whole.push(await this.made(spz));
      this.describe(index, state);
    }
    this.shown = [...this.whole];
    this.scenes = [...this.whole];
  }

  made(spz) {
    return this.drawer.gl ? this.unpacked(spz, "The scene came damaged") : { sorting: { sort() {}, end() {} } };
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
          const scene = percent === 100 ? this.whole[index] : await this.made(spz);
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

  setWipe(share) {
    super.setWipe(share);
    if (!this.drawer.gl) this.change(); // quick pictures while it moves
  }

  get still() {
    return super.still && !this.asking && !this.drawer.asked;
  }

  async ask(index, have) {
    const percent = this.kept[index], isHere = percent === 100 && this.whole[index];
    const answer = await this.post("/scene", { scene: index, percent, have, spz: Boolean(this.drawer.gl && !isHere) });
    return { state: JSON.parse(answer.headers.get("X-State")), spz: new Uint8Array(await answer.arrayBuffer()) };
  }

  // A picture of what the camera sees; null if there is none.
  async picture(values) {
    try {
      const answer = await this.post("/picture", { ...values, wipe: this.wipe, kept: this.kept });
      this.say("");
      return await createImageBitmap(await answer.blob());
    } catch (error) {
      this.say(error.message);
      return null;
    }
  }

  async post(path, values) {
    const body = JSON.stringify({ ...values, stage: this.data.stage });
    const answer = await fetch(path, { method: "POST", body }).catch(() => ({ ok: false }));
    if (answer.status === 409) location.reload(); // another scene is shown by now
    if (!answer.ok) throw new Error("The viewer does not answer. Has pointsplat view ended?");
    return answer;
  }
}

// Draws as Drawer does, with pictures that it asks for, one after the other: small ones while the camera moves.
class Pictures {
  // Throws the error that says why there is no WebGL if nothing can be shown.
  constructor(canvas, why, ask) {
    this.context = canvas.getContext("2d", { alpha: false });
    if (!this.context) throw why;
    this.ask = ask;
  }

  remove() {}

  async draw(camera, style, parts, detail, moving) {
    const { canvas } = this.context, factor = moving ? Math.min(1, QUICK / Math.max(canvas.width, canvas.height)) : 1;
    const [width, height] = [canvas.width, canvas.height].map((side) => Math.round(side * factor));
    this.wanted = { camera: camera.state, width, height, quick: moving };
    if (this.asked) return;
    while ((this.asked = this.wanted)) {
      this.wanted = null;
      const picture = await this.ask(this.asked);
      if (picture) this.context.drawImage(picture, 0, 0, canvas.width, canvas.height);
    }
  }
}
