// The stage of a page: one scene to fly through, or two that a wipe parts, drawn by splats.js as the camera of camera.js
// sees them. It draws only when something has changed; while it moves, with fewer pixels if the machine is slow.

class Flight {
  // `data` is what pointsplat_ns/tools/pages/flight.py gives. The stage says why where nothing can be drawn.
  constructor(root, data) {
    this.data = data;
    this.part = Object.fromEntries([...root.querySelectorAll("[data-flight]")].map((part) => [part.dataset.flight, part]));
    this.canvas = this.part.canvas;
    this.camera = new Camera();
    this.ups = upsFrom(data.up);
    this.upright = 0; // which of these
    this.place(0);
    this.controls = new Controls(this.canvas, this.camera, () => this.change());
    this.scenes = [];
    this.opened = false;
    this.wipe = 0.5;
    this.detail = 1; // share of the pixels each way while it moves
    this.times = []; // of the last frames of a movement
    this.frame = this.settling = 0;
    this.ready = this.open();
  }

  async open() {
    try {
      await this.load();
    } catch (error) {
      this.scenes = [];
      return this.say(error.message);
    }
    this.say("");
    this.opened = true;
    this.listen();
    this.change();
  }

  start() {
    if (!window.DecompressionStream) throw new Error("This browser is too old to unpack the scene.");
    this.drawer = new Drawer(this.canvas);
    this.canvas.addEventListener("webglcontextlost", () => this.say("The graphics driver has stopped. Load the page again."));
  }

  async load() {
    this.start();
    for (const { name, spz } of this.data.scenes) {
      this.say(`Unpacking ${name} …`);
      await new Promise((done) => setTimeout(done)); // the text is seen
      this.scenes.push(await this.unpacked(spz, "The scene in this page is damaged"));
    }
  }

  // What is drawn of an SPZ file, once it can be seen.
  async unpacked(spz, failed) {
    const content = await unpackSpz(spz).catch((error) => {
      throw new Error(`${failed}: ${error.message}`);
    });
    const scene = this.drawer.add(content);
    await new Promise((sorted) => {
      scene.sorting = new Sorting(content.positions, (order) => {
        scene.setOrder(order);
        sorted();
        this.request();
      });
      scene.sorting.sort(this.seenFrom);
    });
    return scene;
  }

  say(text) {
    this.part.message.textContent = text;
    this.part.message.hidden = !text;
  }

  listen() {
    const { part } = this;
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    this.resize();
    this.setDrag(this.data.drag);
    part.drag.addEventListener("change", (event) => this.setDrag(event.target.value));
    part.reset.addEventListener("click", () => this.reset());
    part.turn.addEventListener("click", () => this.turnUp());
    part.full.addEventListener("click", () => this.fill());
    part.views.querySelectorAll("button").forEach((button, index) => button.addEventListener("click", () => this.goTo(index)));
    this.canvas.addEventListener("keydown", (event) => this.press(event));
    if (part.wipe) this.listenToWipe();
    this.sayUp();
  }

  listenToWipe() {
    const { wipe } = this.part;
    const follow = (event) => {
      const { left, width } = this.canvas.getBoundingClientRect();
      this.setWipe((event.clientX - left) / width);
    };
    wipe.addEventListener("pointerdown", (event) => wipe.setPointerCapture(event.pointerId));
    wipe.addEventListener("pointermove", (event) => event.buttons && follow(event));
    wipe.addEventListener("keydown", (event) => {
      const places = { Home: 0, End: 1, ArrowLeft: this.wipe - 0.05, ArrowRight: this.wipe + 0.05 };
      if (!(event.key in places)) return;
      event.preventDefault();
      this.setWipe(places[event.key]);
    });
    this.setWipe(0.5);
  }

  press(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const number = Number(event.key);
    if (number >= 1 && number <= this.data.views.length) this.goTo(number - 1);
    else if (event.code === "KeyR") this.reset();
    else if (event.code === "KeyT") this.turnUp();
    else if (event.code === "KeyF") this.fill();
    else if (event.key === "[" || event.key === "]") this.setWipe(this.wipe + (event.key === "[" ? -0.05 : 0.05));
  }

  // Parts at a share of the width, from the left.
  setWipe(share) {
    if (!this.part.wipe) return;
    this.wipe = Math.max(0, Math.min(1, share));
    this.part.wipe.style.left = `${100 * this.wipe}%`;
    this.part.wipe.setAttribute("aria-valuenow", Math.round(100 * this.wipe));
    this.request();
  }

  setDrag(drag) {
    this.controls.orbits = drag === "orbit";
    for (const input of this.part.drag.querySelectorAll("input")) input.checked = input.value === drag;
  }

  goTo(index) {
    this.place(index);
    this.change();
  }

  place(index) {
    this.at = index;
    this.camera.goTo(this.data.views[index], this.data.up);
    this.camera.fov = this.fitted(index);
    for (const up of this.ups.slice(1, this.upright + 1)) this.camera.stand(up, this.data.drag === "orbit");
  }

  // The field of view along the longer side of the stage, in which all of a view's picture is seen.
  fitted(index) {
    const { aspect, fov } = this.data.views[index], reach = Math.tan(0.5 * fov);
    const wide = this.canvas.clientWidth / this.canvas.clientHeight || aspect;
    const height = Math.max(reach * Math.min(1, 1 / aspect), (reach * Math.min(1, aspect)) / wide);
    return 2 * Math.atan(height * Math.max(1, wide));
  }

  // Turn the scene by a quarter: which way is up was estimated, and may be wrong.
  turnUp() {
    this.upright = (this.upright + 1) % this.ups.length;
    this.camera.stand(this.ups[this.upright], this.data.drag === "orbit");
    this.sayUp();
    this.change();
  }

  sayUp() {
    const up = this.ups[this.upright], name = AXIS_NAMES[AXES.findIndex((axis) => dot(axis, up) > ALONG)];
    const text = name ? name.padStart(2, "+") : up.map((value) => value.toFixed(2)).join(" ");
    this.part.up.textContent = `up: ${text}${this.upright || this.data.sure ? "" : ", a guess"}`;
    this.part.option.textContent = `--up=${name}`;
    this.part.option.parentElement.hidden = !name;
  }

  reset() {
    this.goTo(0);
    this.setWipe(0.5);
  }

  fill() {
    if (document.fullscreenElement) document.exitFullscreen();
    else this.part.stage.requestFullscreen?.().catch(() => {}); // a page that is shown inside another may not
    this.canvas.focus();
  }

  resize() {
    const scale = Math.min(devicePixelRatio, 2), { clientWidth, clientHeight } = this.canvas;
    const [width, height] = [clientWidth, clientHeight].map((side) => Math.max(1, Math.round(side * scale)));
    if (width === this.canvas.width && height === this.canvas.height) return;
    [this.canvas.width, this.canvas.height] = [width, height];
    this.camera.fov = this.fitted(this.at);
    this.change();
  }

  get seenFrom() {
    return { ...this.camera.state, near: this.data.near };
  }

  // The camera is another one: sort anew, and count frames until it stands still.
  change() {
    for (const { sorting } of this.scenes) sorting.sort(this.seenFrom);
    clearTimeout(this.settling);
    this.settling = setTimeout(() => {
      this.settling = 0;
      this.times = [];
      this.request();
    }, 200);
    this.request();
  }

  request() {
    this.frame ||= requestAnimationFrame((now) => this.show(now));
  }

  // Whether what is seen is what will be seen if nobody moves anything.
  get still() {
    return this.opened && !this.frame && !this.settling && !this.scenes.some(({ sorting }) => sorting.busy);
  }

  show(now) {
    this.frame = 0;
    const last = this.times.at(-1) ?? now;
    if (this.controls.step(Math.min(0.1, (now - last) / 1000))) this.change();
    this.paint();
    if (!this.settling) return;
    this.times = [...this.times, now].slice(-30);
    const [first, frames] = [this.times[0], this.times.length - 1];
    if (frames < 4) return;
    const mean = (now - first) / frames;
    this.part.rate.textContent = `${Math.round(1000 / mean)} frames/s`;
    if (mean > 60 && this.detail > 0.25) {
      this.detail /= 2;
      this.times = [];
    }
  }

  paint() {
    const [left, right] = this.scenes, parts = right ? [[left, 0, this.wipe], [right, this.wipe, 1]] : [[left, 0, 1]];
    if (left) this.drawer.draw(this.camera, this.data, parts, this.settling ? this.detail : 1);
  }
}
