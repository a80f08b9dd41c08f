// Logic of the page that needs no browser: state in the address, time, poses, rays, lobes, edges.
import assert from "node:assert/strict";
import { fileURLToPath } from "node:url";
import test from "node:test";
import { build } from "esbuild";

/** Import a module of the page. */
async function load(name) {
  const entry = fileURLToPath(new URL(`../src/${name}.ts`, import.meta.url));
  const { outputFiles } = await build({ entryPoints: [entry], bundle: true, format: "esm", write: false, logLevel: "error" });
  return import(`data:text/javascript;base64,${Buffer.from(outputFiles[0].contents).toString("base64")}`);
}
const near = (found, expected, within = 1e-12) =>
  expected.forEach((value, i) => assert.ok(Math.abs(found[i] - value) <= within, `${found} is not ${expected}`));

test("a view stands in the address and comes back", async () => {
  const { fromFragment, toFragment, INITIAL } = await load("state");
  assert.equal(toFragment(INITIAL), "");
  const state = {
    ...INITIAL,
    n: 120,
    user: "bs|a&b=c/rx|28 GHz",
    sel: "<script>|#%",
    cam: { position: [1.25, -2, 3], target: [0, 0, -1.5] },
    mode: "follow",
    color: "kind",
    min: -110,
    layers: new Set(["rays", "lidar"]),
    dock: "curves",
    speed: 0.5,
    loop: true,
    panel: false,
  };
  const text = toFragment(state);
  assert.match(text, /^n=120&/);
  assert.deepEqual(fromFragment(`#${text}`), { ...state, layers: fromFragment(text).layers });
  assert.deepEqual([...fromFragment(text).layers].sort(), ["lidar", "rays"]);
});

test("an address that was tampered with is the initial view", async () => {
  const { fromFragment, INITIAL } = await load("state");
  for (const text of ["", "n=-3&cam=1,2,x,4,5,6&color=pink&speed=77", "n=&min=&mode=%E0%A4%A", "n=NaN&min=Infinity&layers"]) {
    const { layers, ...rest } = fromFragment(text);
    const { layers: initial, ...others } = INITIAL;
    assert.deepEqual(rest, others, text);
  }
});

test("places are frames of episodes, also of pages that hold every third", async () => {
  const { Timeline } = await load("timeline");
  const blocks = [
    { episode: 0, first_frame: 0, first: 0, count: 10 },
    { episode: 1, first_frame: 5, first: 10, count: 6 },
  ];
  const all = new Timeline(structuredClone(blocks), 0.1);
  assert.deepEqual([all.first, all.last, all.count], [0, 15, 16]);
  assert.deepEqual(all.at(12), { episode: 1, frame: 7, t_s: 7 * 0.1 });
  assert.equal(all.at(16), null);
  assert.equal(all.find(1, 5), 10);
  assert.equal(all.find(1, 4), null);
  assert.equal(all.step(15, 1), 15);
  assert.equal(all.step(15, 2, true), 1);
  assert.equal(all.step(0, -1, true), 15);
  const third = new Timeline(structuredClone(blocks), 0.1, 3);
  assert.deepEqual([third.last, third.count, third.snap(7), third.snap(99), third.step(6, 1)], [15, 6, 6, 15, 9]);
  assert.equal(third.find(0, 4), null);
});

test("a live run grows, begins episodes and forgets", async () => {
  const { Timeline } = await load("timeline");
  const live = new Timeline([], 0.1);
  assert.equal(live.count, 0);
  live.grow(0, [{ episode: 0, first_frame: 0, first: 0, count: 4 }]);
  live.grow(0, [{ episode: 0, first_frame: 2, first: 2, count: 5 }]); // two of them are known
  live.grow(3, [{ episode: 1, first_frame: 0, first: 7, count: 2 }]);
  assert.deepEqual([live.first, live.last], [3, 8]);
  assert.deepEqual(live.at(6), { episode: 0, frame: 6, t_s: 6 * 0.1 });
  assert.equal(live.at(2), null);
  assert.deepEqual(live.episodes, [{ episode: 0, first: 3 }, { episode: 1, first: 7 }]);
});

test("a device stands and points as its mount on its parent says", async () => {
  const { compose, rotate, angles } = await load("scene/pose");
  const half = Math.PI / 4; // a quarter turn to the left, and a nose that points down
  const left = [Math.cos(half), 0, 0, Math.sin(half)];
  const down = [Math.cos(half / 2), 0, Math.sin(half / 2), 0];
  near(rotate(left, [1, 0, 0]), [0, 1, 0]);
  const pose = compose({ position: [10, 20, 1], orientation: left }, { position: [2, 0, 0.5], orientation: down });
  near(pose.position, [10, 22, 1.5]);
  near(rotate(pose.orientation, [1, 0, 0]), [0, Math.SQRT1_2, -Math.SQRT1_2]);
  near(Object.values(angles(pose.orientation)), [Math.PI / 2, -Math.PI / 4, 0]);
});

test("paths have their gains, kinds and points; those of unknown route say so", async () => {
  const { pathsOf, gainRange, kindOf } = await load("scene/rays");
  const array = (data, ...shape) => ({ data: Float64Array.from(data.flat(3)), shape });
  const device = (name, position) => ({ type: "antenna", name, parent: "", position, orientation: [1, 0, 0, 0] });
  const scene = { names: [], devices: [device("tx", [0, 0, 10]), device("rx", [30, 0, 10])] };
  const side = [Math.PI / 2, Math.PI / 2];
  const channel = {
    carriers: [{ name: "a" }, { name: "b" }],
    tx: ["tx"],
    rx: ["rx"],
    offsets: { data: BigInt64Array.of(0n, 3n), shape: [2] },
    id: { data: BigUint64Array.of(7n, 8n, 9n), shape: [3] },
    // Carrier a has no amplitudes: the pair uses b alone.
    a: array([0, 0, 0, 0, 0, 0, 1e-4, 0, 0, 1e-5, 1e-6, 0], 2, 3),
    tau: array([1e-7, 1.2e-7, 1e-7], 3),
    aod: array([[Math.PI / 2, 0], side, side], 3, 2),
    interactions: array([[0, 0], [1, 2], [0, 0]], 3, 2),
    aoa: array([[Math.PI / 2, Math.PI], side, side], 3, 2),
    points: array([0, 0, 0, 0, 0, 0, 10, 10, 10, 20, 10, 10, 0, 0, 0, 0, 0, 0], 3, 2, 3),
  };
  const paths = pathsOf(channel, scene, "a");
  near(paths.map(({ gain }) => gain), [-120, -100, -80], 1e-9);
  assert.deepEqual(paths.map(({ key }) => key), ["tx>rx#9", "tx>rx#8", "tx>rx#7"]);
  assert.deepEqual(paths.map(({ known }) => known), [false, true, true]);
  assert.deepEqual(paths[1].points, [[0, 0, 10], [10, 10, 10], [20, 10, 10], [30, 0, 10]]);
  near(paths[0].leaving, [0, 1, 0]);
  near(paths[2].coming, [-1, 0, 0]);
  assert.equal(kindOf(paths[1]), 2);
  assert.deepEqual(gainRange(paths), [-120, -80]);
});

test("a lobe is the square of the array factor, and the same around either axis", async () => {
  const { gainTowards, lobeMesh } = await load("scene/beams");
  const spaced = (low, high, count) => Array.from({ length: count }, (_, i) => low + (i * (high - low)) / (count - 1));
  const azimuths = spaced(-Math.PI, Math.PI, 361);
  const elevations = spaced(-Math.PI / 2, Math.PI / 2, 181);
  const factor = ([, y]) => Math.abs(Math.cos((Math.PI / 2) * y)); // two elements along y, half a wavelength apart
  for (const axis of ["z", "y"]) {
    const vector = (e, a) => {
      const [u, v, w] = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
      return axis === "y" ? [v, w, u] : [u, v, w];
    };
    const lobe = { device: "bs", beam: 0, axis, azimuths, elevations, gain: elevations.map((e) => azimuths.map((a) => factor(vector(e, a)))) };
    for (const way of [[1, 0, 0], [0.6, 0.8, 0], [-0.36, 0.48, 0.8], [0, -0.6, -0.8]]) near([gainTowards(lobe, way)], [factor(way)], 2e-4);
    const { places, triangles } = lobeMesh(lobe, 10);
    const at = 3 * (90 * 361 + 220);
    const way = vector(elevations[90], azimuths[220]);
    near(places.subarray(at, at + 3), way.map((value) => 10 * factor(way) ** 2 * value), 1e-5);
    assert.ok(triangles.length > 0 && triangles.every((corner) => corner < places.length / 3));
  }
});

test("a box has twelve edges, whether its faces share vertices or not", async () => {
  const { edgesOf } = await load("scene/edges");
  const corners = Array.from({ length: 8 }, (_, i) => [i & 1, (i >> 1) & 1, i >> 2]);
  const quads = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];
  const faces = quads.flatMap(([a, b, c, d]) => [a, b, c, a, c, d]);
  assert.equal(edgesOf(corners.flat(), faces).length, 12 * 6);
  const loose = faces.flatMap((corner) => corners[corner]);
  assert.equal(edgesOf(loose, faces.map((_, i) => i)).length, 12 * 6);
});
