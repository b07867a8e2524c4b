"use strict";

// SPZ files of version 3, as pointsplat_ns/scene/formats/spz.py writes them, turned into texels of four 32-bit words: what
// the shader of splats.js reads. Numbers stay as coarse as the file has them; only positions become floats.

const TEXELS_WIDE = 4096;
const SH_COEFFICIENTS = [0, 3, 8, 15]; // of each channel, beyond the constant one, by SH degree

function bytesOfBase64(text) {
  const letters = atob(text), bytes = new Uint8Array(letters.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = letters.charCodeAt(i);
  return bytes;
}

// `packed` is an array of bytes, or their base64.
async function unpackSpz(packed) {
  const stream = new Blob([typeof packed === "string" ? bytesOfBase64(packed) : packed]).stream();
  const buffer = await new Response(stream.pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
  const head = new DataView(buffer);
  if (head.getUint32(0, true) !== 0x5053474e || head.getUint32(4, true) !== 3) throw new Error("not SPZ of version 3");
  const count = head.getUint32(8, true), degree = head.getUint8(12), step = 2 ** -head.getUint8(13);
  const antialiased = Boolean(head.getUint8(14) & 1);
  const coefficients = 3 * SH_COEFFICIENTS[degree];
  if (buffer.byteLength !== 16 + (20 + coefficients) * count) throw new Error(`SPZ of ${buffer.byteLength} bytes for ${count} Gaussians`);

  const file = new Uint8Array(buffer);
  const position = 16, opacity = position + 9 * count, color = opacity + count, scale = color + 3 * count;
  const rotation = scale + 3 * count, sh = rotation + 4 * count;
  const texels = 2 + Math.ceil(coefficients / 16); // of one Gaussian
  const words = new Uint32Array(4 * TEXELS_WIDE * Math.max(1, Math.ceil((count * texels) / TEXELS_WIDE)));
  const bytes = new Uint8Array(words.buffer), floats = new Float32Array(words.buffer);
  const positions = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) {
    const word = 4 * texels * i, byte = 4 * word;
    for (let axis = 0; axis < 3; axis++) {
      const at = position + 9 * i + 3 * axis;
      const fixed = ((file[at] << 8) | (file[at + 1] << 16) | (file[at + 2] << 24)) >> 8;
      floats[word + axis] = positions[3 * i + axis] = fixed * step;
      bytes[byte + 12 + axis] = file[color + 3 * i + axis];
      bytes[byte + 20 + axis] = file[scale + 3 * i + axis];
    }
    bytes[byte + 15] = file[opacity + i];
    for (let part = 0; part < 4; part++) bytes[byte + 16 + part] = file[rotation + 4 * i + part];
    for (let k = 0; k < coefficients; k++) bytes[byte + 32 + k] = file[sh + coefficients * i + k];
  }
  return { count, degree, antialiased, texels, words, positions };
}
