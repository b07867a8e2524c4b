// A camera that turns, goes and circles, and the mouse, fingers and keys that move it. Axes are those of the package:
// right, down and ahead. Lengths are in units of a tenth of the content's diagonal.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const plus = (a, b, factor = 1) => a.map((value, axis) => value + factor * b[axis]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));

// Rodrigues' formula, with a unit axis.
function turned(vector, axis, angle) {
  const across = cross(axis, vector), along = dot(axis, vector) * (1 - Math.cos(angle));
  return vector.map((value, i) => value * Math.cos(angle) + across[i] * Math.sin(angle) + axis[i] * along);
}

const AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]; // each a quarter turn on
const AXIS_NAMES = ["x", "y", "z", "-x", "-y", "-z"];
const ALONG = 1 - 1e-6; // cosine from which on a direction is an axis

// The directions that may be up: the given one, then the world's axes, from the one after the nearest on.
function upsFrom(up) {
  const along = AXES.map((axis) => dot(axis, up)), nearest = along.indexOf(Math.max(...along));
  const others = AXES.map((_, step) => AXES[(nearest + 1 + step) % 6]);
  return [up, ...(along[nearest] > ALONG ? others.slice(0, 5) : others)];
}

const STEEPEST = 0.99; // cosine between the camera's direction and up: farther, up would change sides
const NEAREST = 0.1; // to what the camera circles about

class Camera {
  // Go to a view: its place `eye`, its axes and its field of view. It circles about what is ahead, level with the middle.
  goTo({ eye, right, down, ahead, fov }, up) {
    Object.assign(this, { eye, right, down, ahead, fov, up });
    const middle = -dot(eye, ahead);
    this.reach = middle > 1 ? middle : 2;
  }

  get state() {
    const { eye, right, down, ahead, fov } = this;
    return { eye, right, down, ahead, fov };
  }

  // Turn to the right and up, radians.
  turn(right, up) {
    const steepness = (axis) => Math.abs(dot(axis, this.up)), tilted = turned(this.ahead, this.right, up);
    const tilt = steepness(tilted) > STEEPEST && steepness(tilted) > steepness(this.ahead) ? 0 : up;
    const moved = (axis) => turned(turned(axis, this.right, tilt), this.up, -right);
    const [down, ahead] = [moved(this.down), moved(this.ahead)];
    this.ahead = unit(ahead); // rounding would add up
    this.right = unit(cross(down, this.ahead));
    this.down = cross(this.ahead, this.right);
  }

  // Stand upright with another up: about the content's middle if the camera circles, else on the spot.
  stand(up, circles) {
    const across = cross(this.up, up), angle = Math.atan2(Math.hypot(...across), dot(this.up, up));
    const moved = (vector) => turned(vector, unit(across), angle);
    if (circles) this.eye = moved(this.eye);
    for (const axis of ["right", "down", "ahead"]) this[axis] = moved(this[axis]);
    this.up = up;
  }

  // Circle about what is ahead: turn, and go aside by as much.
  circle(right, up) {
    const middle = plus(this.eye, this.ahead, this.reach);
    this.turn(right, up);
    this.eye = plus(middle, this.ahead, -this.reach);
  }

  go(right, up, ahead) {
    this.eye = plus(plus(plus(this.eye, this.right, right), this.down, -up), this.ahead, ahead);
  }

  // Come nearer to what is ahead by a share of the distance, or go back from it.
  approach(share) {
    const reach = Math.max(NEAREST, this.reach * (1 - share));
    this.go(0, 0, this.reach - reach);
    this.reach = reach;
  }
}

const GOING = {
  KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyE: [0, 1, 0], KeyQ: [0, -1, 0],
};
const TURNING = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
const SPEED = 2, FAST = 4; // units a second; times as much with Shift
const TURN = 1.2; // radians a second by keys
const CIRCLE_BY = Math.PI; // radians by a drag over the longer side

class Controls {
  // Listens on an element. `orbits` says whether drags circle; `onMove` is called when something begins to move.
  constructor(element, camera, onMove) {
    Object.assign(this, { element, camera, onMove, orbits: false, pointers: new Map(), keys: new Set() });
    const listen = (name, does, options) => element.addEventListener(name, (event) => does.call(this, event), options);
    listen("pointerdown", this.press);
    listen("pointermove", this.drag);
    for (const name of ["pointerup", "pointercancel"]) listen(name, (event) => this.pointers.delete(event.pointerId));
    listen("wheel", this.wheel, { passive: false });
    listen("contextmenu", (event) => event.preventDefault());
    listen("keydown", this.keyDown);
    listen("keyup", (event) => this.keys.delete(event.code));
    listen("blur", () => this.keys.clear());
  }

  press(event) {
    this.element.focus({ preventScroll: true });
    this.element.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    event.preventDefault();
  }

  // One finger or the left button turns. Two fingers, another button or Shift shift the view; fingers apart come nearer.
  drag(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], several = this.pointers.size > 1;
    const side = Math.max(this.element.clientWidth, this.element.clientHeight);
    const [x, y] = [0, 1].map((axis) => (now[axis] - before[axis]) / side);
    this.pointers.set(event.pointerId, now);
    if (several || event.shiftKey || event.buttons > 1) {
      const wide = 2 * this.camera.reach * Math.tan(0.5 * this.camera.fov), share = wide / this.pointers.size;
      this.camera.go(-x * share, y * share, 0);
      if (several) {
        const [other] = [...this.pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
        const apart = (place) => Math.max(1, Math.hypot(place[0] - other[0], place[1] - other[1]));
        this.approach(1 - apart(before) / apart(now));
      }
    } else if (this.orbits) this.camera.circle(x * CIRCLE_BY, -y * CIRCLE_BY);
    else this.camera.turn(-x * this.camera.fov, y * this.camera.fov); // what is below the pointer stays there
    this.onMove();
  }

  // Come nearer by a share of the distance to what the camera circles about, which goes ahead of it where it does not.
  approach(share) {
    if (this.orbits) this.camera.approach(share);
    else this.camera.go(0, 0, this.camera.reach * share);
  }

  // Pages are scrolled by the wheel as well: it is taken only once the scene has been clicked.
  wheel(event) {
    if (document.activeElement !== this.element) return;
    event.preventDefault();
    const lines = event.deltaMode === 0 ? event.deltaY / 30 : event.deltaY;
    this.approach(1 - 1.05 ** Math.max(-10, Math.min(10, lines)));
    this.onMove();
  }

  keyDown(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (!(event.code in GOING || event.code in TURNING)) return;
    event.preventDefault();
    this.keys.add(event.code);
    this.fast = event.shiftKey;
    this.onMove();
  }

  // Move by what keys are held, for some seconds. Whether there were any.
  step(seconds) {
    for (const key of this.keys) {
      const length = SPEED * seconds * (this.fast ? FAST : 1), angle = TURN * seconds;
      if (key in GOING) this.camera.go(...GOING[key].map((direction) => direction * length));
      else if (this.orbits) this.camera.circle(...TURNING[key].map((direction) => -direction * angle));
      else this.camera.turn(...TURNING[key].map((direction) => direction * angle));
    }
    return this.keys.size > 0;
  }
}
