// Colours that colour-blind readers distinguish: Okabe and Ito (2008), viridis, cividis.

export const ORANGE = "#e69f00";
export const SKY = "#56b4e9";
export const GREEN = "#009e73";
export const YELLOW = "#f0e442";
export const BLUE = "#0072b2";
export const VERMILION = "#d55e00";
export const PURPLE = "#cc79a7";

/** Chosen pair of beams, best pair, straight line: in the scene and in curves. */
export const CHOSEN = VERMILION;
export const BEST = GREEN;
export const STRAIGHT = BLUE;
/** Objects and users that differ between two runs. */
export const DIFFERENT = PURPLE;

const VIRIDIS = "440154 482878 3e4989 31688e 26828e 1f9e89 35b779 6ece58 b5de2b fde725";
const CIVIDIS = "00224e 123570 3b496c 575d6d 707173 8a8678 a59c74 c3b369 e1cc55 fee838";

export type Rgb = [number, number, number];

/** sRGB from 0 to 1 of `#rrggbb`. */
export function rgb(hex: string): Rgb {
  const value = Number.parseInt(hex.replace("#", ""), 16);
  return [(value >> 16) / 255, ((value >> 8) & 255) / 255, (value & 255) / 255];
}

function map(stops: string): (share: number) => Rgb {
  const colors = stops.split(" ").map(rgb);
  return (share) => {
    const at = Math.max(0, Math.min(1, share)) * (colors.length - 1);
    const low = Math.min(Math.floor(at), colors.length - 2);
    return colors[low].map((from, i) => from + (at - low) * (colors[low + 1][i] - from)) as Rgb;
  };
}

/** Colour maps from 0 to 1. */
export const viridis = map(VIRIDIS);
export const cividis = map(CIVIDIS);

export const css = (color: Rgb): string => `rgb(${color.map((value) => Math.round(255 * value)).join(" ")})`;

/** Kinds of `Channel.interactions`; 0 stands for a path without any. */
export const KINDS = [
  { name: "line of sight", color: YELLOW },
  { name: "reflection", color: SKY },
  { name: "diffraction", color: ORANGE },
  { name: "scattering", color: GREEN },
  { name: "transmission", color: PURPLE },
] as const;

/** Paths by their number of interactions; the last colour is that of all above. */
export const ORDERS = [YELLOW, SKY, ORANGE, GREEN, PURPLE, BLUE] as const;
