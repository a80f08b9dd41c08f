// Colours of the sky, the ground and the light, by day and in the dark.

export interface Theme {
  dark: boolean;
  zenith: string;
  horizon: string;
  ground: string;
  grid: string;
  edges: string;
  edgeOpacity: number;
  /** Lines and points that have no colour of their own. */
  ink: string;
  casing: string;
  /** Factor of the colours of materials. */
  shade: number;
  sky: string;
  bounce: string;
  sun: string;
  ambient: number;
  sunlight: number;
}

export const LIGHT: Theme = {
  dark: false,
  zenith: "#7fa9d6",
  horizon: "#e6eef5",
  ground: "#cdd0c8",
  grid: "#6f7672",
  edges: "#3a3f45",
  edgeOpacity: 0.42,
  ink: "#1b1f24",
  casing: "#10151b",
  shade: 0.92,
  sky: "#dfeafb",
  bounce: "#a89f90",
  sun: "#fff3dd",
  ambient: 2.0,
  sunlight: 2.45,
};

export const DARK: Theme = {
  dark: true,
  zenith: "#070b14",
  horizon: "#1d2738",
  ground: "#1a2029",
  grid: "#7d8ba0",
  edges: "#a9bcd6",
  edgeOpacity: 0.3,
  ink: "#eef3fa",
  casing: "#000000",
  shade: 0.42,
  sky: "#8fa9d8",
  bounce: "#2b2f3a",
  sun: "#c9d8ff",
  ambient: 1.5,
  sunlight: 1.2,
};
