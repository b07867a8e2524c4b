// Draws Gaussians with WebGL 2 by the formulas and thresholds of pointsplat_ns/render: the covariance is projected
// by the Jacobian at the mean (EWA splatting), 0.3 pixels^2 are added to it, and what has an alpha of 1/255 or more is
// blended, from back to front. Colours are summed up in 16-bit floats.

const GAUSSIAN_SHADER = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;

uniform usampler2D gaussians;
uniform int texels, degree;          // texels of one Gaussian
uniform vec3 eye, right, down, ahead; // the camera, in the world
uniform vec2 size;                   // of the image, pixels
uniform float focal, near;           // pixels; scene units
uniform bool antialiased;
layout(location = 0) in uint index;
out vec2 place;                      // in standard deviations
flat out vec4 color;                 // and opacity

const float EPS2D = 0.3, ALPHA_MIN = 1.0 / 255.0, COMPENSATION_MIN = 0.005, MARGIN = 1.3;
uint words[12];

uvec4 texel(int offset) {
  int at = int(index) * texels + offset;
  return texelFetch(gaussians, ivec2(at % ${TEXELS_WIDE}, at / ${TEXELS_WIDE}), 0);
}

float byteOf(uint word, int place) { return float((word >> (8 * place)) & 255u); }

float level(int place) { return byteOf(words[place >> 2], place & 3) / 128.0 - 1.0; }

vec3 sh(int k) { return vec3(level(3 * k), level(3 * k + 1), level(3 * k + 2)); }

vec3 seenAlong(vec3 d) {
  for (int part = 0; part < 3; part++) {
    uvec4 four = part + 2 < texels ? texel(part + 2) : uvec4(0);
    words[4 * part] = four.x; words[4 * part + 1] = four.y; words[4 * part + 2] = four.z; words[4 * part + 3] = four.w;
  }
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = 0.4886025119029199 * (z * sh(1) - y * sh(0) - x * sh(2));
  if (degree > 1)
    sum += 1.0925484305920792 * (x * y * sh(3) - y * z * sh(4) - x * z * sh(6)) +
      0.31539156525252005 * (2.0 * zz - xx - yy) * sh(5) + 0.5462742152960396 * (xx - yy) * sh(7);
  if (degree > 2) {
    float around = 4.0 * zz - xx - yy;
    sum += -0.5900435899266435 * (y * (3.0 * xx - yy) * sh(8) + x * (xx - 3.0 * yy) * sh(14)) +
      2.890611442640554 * x * y * z * sh(9) - 0.4570457994644658 * around * (y * sh(10) + x * sh(12)) +
      0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * sh(11) + 1.445305721320277 * z * (xx - yy) * sh(13);
  }
  return sum;
}

// The quaternion of which the largest component is left out; xyzw.
vec4 rotationOf(uint word) {
  vec3 others;
  for (int i = 0; i < 3; i++) {
    uint bits = word >> (20 - 10 * i);
    others[i] = float(bits & 511u) / 511.0 * ((bits & 512u) != 0u ? -0.7071067811865476 : 0.7071067811865476);
  }
  float largest = sqrt(max(0.0, 1.0 - dot(others, others)));
  uint which = word >> 30;
  if (which == 0u) return vec4(largest, others);
  if (which == 1u) return vec4(others.x, largest, others.yz);
  if (which == 2u) return vec4(others.xy, largest, others.z);
  return vec4(others, largest);
}

vec3 turnedBack(vec4 q, vec3 v) { return v - 2.0 * cross(q.xyz, q.w * v - cross(q.xyz, v)); }

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // outside: not drawn
  uvec4 first = texel(0);
  vec3 seen = uintBitsToFloat(first.xyz) - eye;
  vec3 point = vec3(dot(right, seen), dot(down, seen), dot(ahead, seen));
  if (point.z <= near) return;
  uvec4 second = texel(1);
  vec3 scale = exp(vec3(byteOf(second.y, 0), byteOf(second.y, 1), byteOf(second.y, 2)) / 16.0 - 10.0);

  vec2 slope = point.xy / point.z, most = 0.5 * MARGIN * size / focal;
  vec2 bounded = clamp(slope, -most, most);
  vec4 q = rotationOf(second.x);
  vec3 reach = scale * focal / point.z;
  vec3 p1 = turnedBack(q, right - bounded.x * ahead) * reach, p2 = turnedBack(q, down - bounded.y * ahead) * reach;
  vec3 normal = cross(p1, p2);
  float xx = dot(p1, p1), yy = dot(p2, p2), xy = dot(p1, p2), sharp = dot(normal, normal);
  float det = sharp + EPS2D * (xx + yy) + EPS2D * EPS2D;
  xx += EPS2D;
  yy += EPS2D;
  float opacity = clamp(byteOf(first.w, 3), 0.25, 254.75) / 255.0;
  if (antialiased) opacity *= sqrt(max(sharp / det, COMPENSATION_MIN * COMPENSATION_MIN));
  if (opacity <= ALPHA_MIN) return;

  // The axes of the ellipse, which is drawn as far as its alpha is 1/255.
  float wider = 0.5 * (xx - yy), spread = sqrt(wider * wider + xy * xy), longer = 0.5 * (xx + yy) + spread;
  vec2 axis = wider > 0.0 ? vec2(wider + spread, xy) : vec2(xy, spread - wider);
  axis = spread > 1e-6 * longer ? normalize(axis) : vec2(1.0, 0.0);
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  place = corner * sqrt(2.0 * log(opacity / ALPHA_MIN));
  vec2 offset = place.x * sqrt(longer) * axis + place.y * sqrt(det / longer) * vec2(-axis.y, axis.x);
  vec2 middle = slope * focal;
  if (any(greaterThan(abs(middle), 0.5 * size + 3.4 * sqrt(longer)))) return; // an alpha of 1/255 is 3.33 deviations away
  gl_Position = vec4(2.0 * (middle + offset) / size * vec2(1.0, -1.0), 0.0, 1.0);

  vec3 constant = (vec3(byteOf(first.w, 0), byteOf(first.w, 1), byteOf(first.w, 2)) / 255.0 - 0.5) / 0.15;
  vec3 sum = 0.5 + 0.28209479177387814 * constant + (degree > 0 ? seenAlong(normalize(seen)) : vec3(0.0));
  color = vec4(max(sum, 0.0), opacity);
}`;

const BLEND_SHADER = `#version 300 es
precision highp float;
in vec2 place;
flat in vec4 color;
out vec4 drawn;
void main() {
  float alpha = min(0.999, color.a * exp(-0.5 * dot(place, place)));
  if (alpha < 1.0 / 255.0) discard;
  drawn = vec4(color.rgb * alpha, alpha);
}`;

const WHOLE_SHADER = `#version 300 es
out vec2 place;
void main() {
  place = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
  gl_Position = vec4(2.0 * place - 1.0, 0.0, 1.0);
}`;

const COPY_SHADER = `#version 300 es
precision highp float;
uniform sampler2D image;
in vec2 place;
out vec4 drawn;
void main() { drawn = vec4(texture(image, place).rgb, 1.0); }`;

// From a camera to the indices of what lies in front of it, the farthest first. Depths above 0 have the order of their
// bits: they are sorted by the lower half of these, then by the upper one. This function is also the worker's program.
function makeSorter(positions) {
  const count = positions.length / 3, depth = new Float32Array(1), bits = new Uint32Array(depth.buffer);
  const keys = new Uint32Array(count), before = new Uint32Array(count), half = new Uint32Array(count);
  return ({ eye, ahead, near }) => {
    const low = new Uint32Array(65537), high = new Uint32Array(65537);
    const offset = ahead[0] * eye[0] + ahead[1] * eye[1] + ahead[2] * eye[2];
    let shown = 0;
    for (let i = 0; i < count; i++) {
      depth[0] = ahead[0] * positions[3 * i] + ahead[1] * positions[3 * i + 1] + ahead[2] * positions[3 * i + 2] - offset;
      if (!(depth[0] > near)) continue;
      const key = ~bits[0] >>> 0;
      keys[i] = key;
      before[shown++] = i;
      low[(key & 65535) + 1]++;
      high[(key >>> 16) + 1]++;
    }
    for (let i = 0; i < 65536; i++) {
      low[i + 1] += low[i];
      high[i + 1] += high[i];
    }
    for (let i = 0; i < shown; i++) half[low[keys[before[i]] & 65535]++] = before[i];
    const order = new Uint32Array(shown);
    for (let i = 0; i < shown; i++) order[high[keys[half[i]] >>> 16]++] = half[i];
    return order;
  };
}

// Sorts in a worker. While it is at work, only the latest camera waits.
class Sorting {
  constructor(positions, onSorted) {
    this.onSorted = onSorted;
    this.waiting = null;
    this.working = null;
    const program = `${makeSorter}
      let sort;
      onmessage = ({ data }) => {
        if (data.positions) return void (sort = makeSorter(data.positions));
        const order = sort(data);
        postMessage(order, [order.buffer]);
      };`;
    this.worker = new Worker(URL.createObjectURL(new Blob([program], { type: "text/javascript" })));
    this.worker.onmessage = ({ data }) => this.finish(data);
    this.worker.postMessage({ positions });
  }

  get busy() {
    return this.working !== null;
  }

  sort(camera) {
    this.waiting = camera;
    if (!this.busy) this.next();
  }

  next() {
    [this.working, this.waiting] = [this.waiting, null];
    if (this.busy) this.worker.postMessage(this.working);
  }

  finish(order) {
    this.working = null;
    this.onSorted(order);
    this.next();
  }

  end() {
    this.onSorted = () => {};
    this.worker.terminate();
  }
}

class Drawer {
  // Throws an error that says why where there is no such WebGL 2.
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
    const isFloat = gl?.getExtension("EXT_color_buffer_float") || gl?.getExtension("EXT_color_buffer_half_float");
    if (!isFloat) throw new Error("This browser offers no WebGL 2 with float colours, which draws the scene. Another browser, or one with a graphics driver, shows it.");
    this.gl = gl;
    this.gaussian = this.program(GAUSSIAN_SHADER, BLEND_SHADER);
    this.copy = this.program(WHOLE_SHADER, COPY_SHADER);
    this.image = gl.createTexture();
    this.target = gl.createFramebuffer();
    this.nothing = gl.createVertexArray();
    this.width = this.height = 0;
  }

  program(...sources) {
    const { gl } = this, program = gl.createProgram();
    sources.forEach((source, index) => {
      const shader = gl.createShader(index ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    });
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error(`The graphics driver refuses the program that draws the scene: ${gl.getProgramInfoLog(program)}`);
    const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) ?? 0;
    const names = Array.from({ length: count }, (_, index) => gl.getActiveUniform(program, index).name);
    return { program, at: Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)])) };
  }

  // What is drawn of an unpacked scene. Its order is to be set before.
  add({ count, degree, antialiased, texels, words }) {
    const { gl } = this, texture = gl.createTexture(), array = gl.createVertexArray(), indices = gl.createBuffer();
    const rows = words.length / (4 * TEXELS_WIDE);
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error(`${count} Gaussians are more than the graphics driver takes.`);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, TEXELS_WIDE, rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, indices);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    const setOrder = (order) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, indices);
      gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
      scene.shown = order.length;
    };
    const scene = { texture, array, indices, texels, degree, antialiased, shown: 0, setOrder };
    return scene;
  }

  remove({ texture, array, indices }) {
    this.gl.deleteTexture(texture);
    this.gl.deleteVertexArray(array);
    this.gl.deleteBuffer(indices);
  }

  resize(width, height) {
    if (width === this.width && height === this.height) return;
    const { gl } = this;
    [this.width, this.height] = [width, height];
    gl.bindTexture(gl.TEXTURE_2D, this.image);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width, height, 0, gl.RGBA, gl.HALF_FLOAT, null);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.image, 0);
  }

  // Draw scenes beside one another as one camera sees them: `parts` are [scene, from, to], shares of the width. The
  // image has `detail` times the pixels of the canvas each way.
  draw(camera, style, parts, detail) {
    const { gl } = this, { canvas } = gl;
    this.resize(Math.max(1, Math.round(canvas.width * detail)), Math.max(1, Math.round(canvas.height * detail)));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.viewport(0, 0, this.width, this.height);
    gl.clearColor(...style.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.enable(gl.SCISSOR_TEST);
    const { program, at } = this.gaussian;
    gl.useProgram(program);
    for (const axis of ["eye", "right", "down", "ahead"]) gl.uniform3fv(at[axis], camera[axis]);
    gl.uniform2f(at.size, this.width, this.height);
    gl.uniform1f(at.focal, (0.5 * Math.max(this.width, this.height)) / Math.tan(0.5 * camera.fov));
    gl.uniform1f(at.near, style.near);
    for (const [scene, from, to] of parts) {
      const left = Math.round(from * this.width), width = Math.round(to * this.width) - left;
      if (!width || !scene.shown) continue;
      gl.scissor(left, 0, width, this.height);
      gl.uniform1i(at.antialiased, style.antialiased || scene.antialiased);
      gl.uniform1i(at.texels, scene.texels);
      gl.uniform1i(at.degree, scene.degree);
      gl.bindTexture(gl.TEXTURE_2D, scene.texture);
      gl.bindVertexArray(scene.array);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, scene.shown);
    }
    gl.disable(gl.SCISSOR_TEST);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.useProgram(this.copy.program);
    gl.bindTexture(gl.TEXTURE_2D, this.image);
    gl.bindVertexArray(this.nothing);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
}
