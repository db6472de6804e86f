// Pictures: radiance out of the page, and its way to the screen.

const PAYLOAD_BITS = 13; // of a half float, without the last three of its mantissa
const MASK = (1 << PAYLOAD_BITS) - 1;

const HALF = new Float32Array(1 << 16);
for (let i = 0; i < HALF.length; i++) {
  const exponent = (i >> 10) & 31;
  const mantissa = i & 1023;
  HALF[i] = exponent ? 2 ** (exponent - 25) * (1024 + mantissa) : 2 ** -24 * mantissa;
}

const decoded = new Map();

// Radiance of picture `id`, RGB by pixel, as a promise.
function picture(id) {
  if (!decoded.has(id)) decoded.set(id, decode(document.getElementById(`picture-${id}`).textContent.trim()));
  return decoded.get(id);
}

async function decode(text) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  // high bytes then low bytes of the planes R - G, G, B - G
  const values = bytes.length / 2;
  const pixels = values / 3;
  const at = (plane, i) => (bytes[plane * pixels + i] << 8) | bytes[values + plane * pixels + i];
  const result = new Float32Array(values);
  for (let i = 0; i < pixels; i++) {
    const green = at(1, i);
    result[3 * i] = HALF[((at(0, i) + green) & MASK) << 3];
    result[3 * i + 1] = HALF[green << 3];
    result[3 * i + 2] = HALF[((at(2, i) + green) & MASK) << 3];
  }
  return result;
}

const SRGB = new Uint8ClampedArray((1 << 16) + 1);
for (let i = 0; i < SRGB.length; i++) {
  const x = i / (1 << 16);
  SRGB[i] = Math.floor(255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055) + 0.5);
}
const encode = (x) => SRGB[(x * (1 << 16) + 0.5) | 0];

// The library's tone curve (Khronos PBR Neutral without its subtraction), then sRGB. Alpha stays 255: a canvas
// multiplies colours by it and would lose what is transparent.
function toneMap(radiance, exposure, out) {
  const gain = 2 ** exposure;
  for (let i = 0, j = 0; i < radiance.length; i += 3, j += 4) {
    let r = radiance[i] * gain;
    let g = radiance[i + 1] * gain;
    let b = radiance[i + 2] * gain;
    const peak = Math.max(r, g, b);
    if (peak > 0.8) {
      const compressed = 1 - 0.04 / (peak - 0.6);
      const keep = 1 / (0.15 * (peak - compressed) + 1);
      const scale = (compressed / peak) * keep;
      const white = compressed * (1 - keep);
      r = r * scale + white;
      g = g * scale + white;
      b = b * scale + white;
    }
    out[j] = encode(r);
    out[j + 1] = encode(g);
    out[j + 2] = encode(b);
    out[j + 3] = 255;
  }
}

// Each pixel's share in relMSE, as the library defines it.
function relativeSquares(radiance, reference) {
  let mean = 0;
  for (const x of reference) mean += x / reference.length;
  const scale = mean > 0 ? 0.5 / mean : 1;
  const result = new Float32Array(radiance.length / 3);
  for (let i = 0; i < radiance.length; i++) {
    const ref = scale * reference[i];
    const difference = scale * radiance[i] - ref;
    result[(i / 3) | 0] += (difference * difference) / (ref * ref + 0.01) / 3;
  }
  return result;
}

const ERROR_DECADES = [-4, 1];
// Inferno, of matplotlib, at even steps.
const INFERNO = ["#000004", "#1b0c41", "#4a0c6b", "#781c6d", "#a52c60", "#cf4446", "#ed6925", "#fb9b06", "#f7d13d", "#fcffa4"];
const RAMP = INFERNO.map((text) => [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16)));

function falseColour(errors, out) {
  const [low, high] = ERROR_DECADES;
  for (let i = 0, j = 0; i < errors.length; i++, j += 4) {
    const share = Math.min(1, Math.max(0, (Math.log10(errors[i] + 1e-30) - low) / (high - low)));
    const place = share * (RAMP.length - 1);
    const k = Math.min(RAMP.length - 2, place | 0);
    for (let c = 0; c < 3; c++) out[j + c] = RAMP[k][c] + (place - k) * (RAMP[k + 1][c] - RAMP[k][c]);
    out[j + 3] = 255;
  }
}

// Stops that bring the brighter pixels of a picture to the end of the tone curve's straight part.
function autoExposure(radiance) {
  const peaks = [];
  for (let i = 0; i < radiance.length; i += 3) peaks.push(Math.max(radiance[i], radiance[i + 1], radiance[i + 2]));
  peaks.sort((a, b) => a - b);
  const bright = peaks[Math.floor(0.95 * (peaks.length - 1))];
  return bright > 0 ? Math.min(12, Math.max(-6, Math.round(4 * Math.log2(0.8 / bright)) / 4)) : 0;
}
