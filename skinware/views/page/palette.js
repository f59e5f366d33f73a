// Colours of levels: the further from the ground, the more. Brightness alone distinguishes levels.

export const TOP = 250; // levels 0 to 250

const RAMPS = {
  dark: "352b5c 40407f 3b5b8e 2f738e 23898e 22a085 44bb72 7fd150 c2df2c fde725",
  light: "dbe4ec c3d9e2 9fcfd3 74bfc2 4aa9b4 3390a8 2f759a 335a8a 363f76 33265d 260c40",
};

const hex = (text) => [0, 2, 4].map((at) => parseInt(text.slice(at, at + 2), 16));

/**
 * Colours of the levels 0 to 255.
 * @param {"dark" | "light"} theme
 * @returns {Uint8Array} 256 x RGBA; above 250: as 0.
 */
export function ramp(theme) {
  const anchors = RAMPS[theme].split(" ").map(hex);
  const colours = new Uint8Array(256 * 4);
  for (let level = 0; level < 256; level++) {
    const at = (level > TOP ? 0 : level / TOP) * (anchors.length - 1);
    const low = Math.min(Math.floor(at), anchors.length - 2);
    for (let c = 0; c < 3; c++) {
      colours[4 * level + c] = Math.round(anchors[low][c] + (at - low) * (anchors[low + 1][c] - anchors[low][c]));
    }
    colours[4 * level + 3] = 255;
  }
  return colours;
}

/** The scale as a CSS gradient, from low to high. */
export function gradient(theme, direction = "to right") {
  return `linear-gradient(${direction}, ${RAMPS[theme].split(" ").map((text) => `#${text}`).join(", ")})`;
}

/** The ground on which taxels lie, and the ink for rims and signs, as RGB 0 to 255. */
export const GROUND = { dark: [16, 18, 22], light: [247, 248, 250] };
/** What is behind taxels: the fingers of a nominal hand. */
export const BODY = { dark: [32, 36, 44], light: [236, 239, 243] };
export const INK = { dark: [233, 237, 243], light: [24, 30, 40] };
