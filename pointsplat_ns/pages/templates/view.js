// The viewer's stage: the server draws what the camera sees, small while it moves, at the size of the stage at rest.

const AGAIN = 2000; // milliseconds until a server that has gone is asked again

class View extends Flight {
  async open() {
    this.client = [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
    this.context = this.canvas.getContext("2d", { alpha: false });
    this.scenes = this.data.scenes.map(() => ({ sorting: { sort() {}, busy: false } }));
    this.two = this.data.kept.length > 1;
    this.kept = [...this.data.kept];
    this.look = 0; // number of the newest camera that the server was sent
    this.state = { number: 0, texts: 0, made: 0, look: -1 };
    this.say("Drawing …");
    this.opened = true;
    this.listen();
    this.root = this.part.stage.parentElement;
    this.root.querySelectorAll("[data-kept]").forEach((slider, index) => {
      slider.addEventListener("input", () => this.keep(index, Number(slider.value)));
    });
    this.compare();
    this.change();
    this.follow();
  }

  keep(index, percent) {
    this.kept[index] = percent;
    this.compare();
    this.request();
  }

  // One scene is compared with all of itself, once less than all of it is kept.
  compare() {
    const compares = this.two || this.kept[0] < 100;
    this.part.wipe.hidden = !compares;
    this.part.stage.querySelector(".flight-name.right").hidden = !compares;
  }

  get still() {
    return !this.frame && !this.wanted && !this.sending && this.state.look === this.look;
  }

  show(now) {
    this.frame = 0;
    const seconds = Math.min(0.1, (now - (this.last ?? now)) / 1000);
    if (this.controls.step(seconds)) this.change();
    this.last = this.controls.keys.size ? now : undefined;
    this.paint();
  }

  resize() {
    super.resize();
    this.put();
  }

  // Put the newest picture on the stage.
  put() {
    if (!this.picture) return;
    this.context.imageSmoothingQuality = "high";
    this.context.drawImage(this.picture, 0, 0, this.canvas.width, this.canvas.height);
  }

  paint() {
    this.wanted = true;
    this.note();
    if (!this.sending) this.send();
  }

  async send() {
    this.sending = true;
    while (this.wanted) {
      this.wanted = false;
      this.look += 1;
      const { width, height } = this.canvas, { wipe, kept, look } = this;
      await this.post("/look", { camera: this.camera.state, width, height, wipe, kept, look }).catch(() => {}); // follow() says it
    }
    this.sending = false;
  }

  async post(path, values) {
    const body = JSON.stringify({ ...values, client: this.client, stage: this.data.stage });
    const answer = await fetch(path, { method: "POST", body });
    if (answer.status === 409) location.reload(); // another scene is shown by now
    if (!answer.ok) throw new Error(answer.status);
    return answer;
  }

  // Ask for the next picture, for ever.
  async follow() {
    for (let gone = false; ; ) {
      try {
        const { number, texts } = this.state, answer = await this.post("/picture", { number, texts });
        const state = JSON.parse(answer.headers.get("X-State"));
        if (answer.status === 200) {
          const before = this.picture;
          this.picture = await createImageBitmap(await answer.blob());
          this.put();
          before?.close();
          this.say("");
        }
        if (gone || state.made !== this.state.made) this.request();
        gone = false;
        this.state = state;
        this.describe(state.scenes);
      } catch {
        gone = true;
        this.say("The viewer does not answer. Has pointsplat view ended?");
        await new Promise((done) => setTimeout(done, AGAIN));
      }
    }
  }

  describe(scenes) {
    const amounts = this.part.stage.querySelectorAll(".flight-name span");
    scenes.forEach(({ amount, command }, index) => {
      amounts[index].textContent = amount;
      this.root.querySelectorAll(".kept output")[index].textContent = `${this.kept[index]} %`;
      const code = this.root.querySelectorAll(".kept code")[index];
      code.textContent = command;
      code.hidden = !command;
    });
    this.note();
  }

  note() {
    this.part.rate.textContent = this.still ? "" : "sharpening …";
  }
}

const data = JSON.parse(document.getElementById("data").textContent);
const flight = new View(document.getElementById("flight"), data.flight);
document.querySelector("canvas").focus({ preventScroll: true });
