// The spectrum of a line: how much of it swings at each frequency.

const LEAST = 16; // samples
const MOST = 16_384;

/**
 * The amplitudes of the longest piece without a gap; its samples are laid evenly in time, and windowed (Hann).
 * @returns {?{step_hz: number, rate_hz: number, amplitude: Float64Array}} amplitude in the unit of the values, of
 *     0, 1, 2 ... steps; null of too few samples.
 */
export function spectrumOf(times, values) {
  const [start, end] = longestPiece(values);
  if (end - start < LEAST) return null;
  const n = Math.min(MOST, 2 ** Math.floor(Math.log2(end - start)));
  const begin = end - n;
  const [first, last] = [times[begin], times[end - 1]];
  const rate_hz = (1e9 * (n - 1)) / (last - first);
  const real = new Float64Array(n);
  const imaginary = new Float64Array(n);
  for (let k = 0, at = begin; k < n; k++) {
    const time = first + (k * (last - first)) / (n - 1);
    while (at < end - 2 && times[at + 1] < time) at++;
    const share = Math.min(1, (time - times[at]) / (times[at + 1] - times[at]));
    real[k] = values[at] + share * (values[at + 1] - values[at]);
  }
  const mean = real.reduce((sum, value) => sum + value, 0) / n;
  for (let k = 0; k < n; k++) real[k] = (real[k] - mean) * (0.5 - 0.5 * Math.cos((2 * Math.PI * k) / n));
  transform(real, imaginary);
  const amplitude = Float64Array.from({ length: n / 2 + 1 }, (_, k) => (4 / n) * Math.hypot(real[k], imaginary[k]));
  return { step_hz: rate_hz / n, rate_hz, amplitude };
}

/** The first place of the longest piece without a gap, and the one after it; of two, the newer. */
function longestPiece(values) {
  let best = [0, 0];
  for (let begin = 0, k = 0; k <= values.length; k++) {
    if (k < values.length && !Number.isNaN(values[k])) continue;
    if (k - begin >= best[1] - best[0]) best = [begin, k];
    begin = k + 1;
  }
  return best;
}

/** The Fourier transform in place, of 2^m numbers. */
function transform(real, imaginary) {
  const n = real.length;
  for (let k = 1, turned = 0; k < n; k++) {
    let bit = n >> 1;
    for (; turned & bit; bit >>= 1) turned ^= bit;
    turned ^= bit;
    if (k < turned) for (const part of [real, imaginary]) [part[k], part[turned]] = [part[turned], part[k]];
  }
  for (let half = 1; half < n; half *= 2) {
    for (let k = 0; k < half; k++) {
      const [c, s] = [Math.cos((Math.PI * k) / half), -Math.sin((Math.PI * k) / half)];
      for (let one = k; one < n; one += 2 * half) {
        const other = one + half;
        const [a, b] = [c * real[other] - s * imaginary[other], s * real[other] + c * imaginary[other]];
        [real[other], imaginary[other]] = [real[one] - a, imaginary[one] - b];
        real[one] += a;
        imaginary[one] += b;
      }
    }
  }
}
