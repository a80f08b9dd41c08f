// What the library in clients/js does without a broker: node --test js_library.test.mjs
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import {
  Agent,
  cos,
  encodePayload,
  generator,
  GODOT,
  multiply,
  quaternion,
  sin,
  THREE,
  THREE_MODEL,
  World,
  wxyz,
  xyzw,
} from "../../clients/js/src/index.mjs";
import { encode, Float } from "../../clients/js/src/messagepack.mjs";
import { decodeMessage } from "../../clients/js/src/messages.mjs";
import { matches, Mounts } from "../../clients/js/src/mounts.mjs";
import { sceneOf } from "../../clients/js/src/scene.mjs";
import { Assets } from "../../clients/js/src/scenery.mjs";
import { byBytes } from "../../clients/js/src/schema.mjs";
import { sha256 } from "../../clients/js/src/sha256.mjs";
import { decodePayload } from "../../clients/js/src/topics.mjs";

const VECTORS = new URL("../../protocol/vectors/", import.meta.url);
const bytes = (name) => readFileSync(new URL(name, VECTORS));
const utf8 = (text) => new TextEncoder().encode(text);
const CAR = { name: "car", class: "car", position: [1, 2, 3], velocity: [0, 0, 0], dimensions: [4, 2, 1.5] };
const rules = (more = {}) => ({ prefixes: ["car", "uav"], offered: () => false, devices: () => [], ...more });

test("devices are those of the vectors, frame by frame", () => {
  const welcome = decodeMessage([bytes("welcome_mounts.msgpack")]);
  const mounts = new Mounts(welcome.scenario.devices);
  const arrivals = [["car.2", "uav"], ["car.1"], ["car.0"], [], ["car.2"]];
  let order = [];
  arrivals.forEach((arrived, frame) => {
    const expected = decodePayload("scene", bytes(`mounts_${frame}.msgpack`), bytes(`mounts_${frame}.body`));
    order = [...order, ...arrived].filter((name) => expected.names.includes(name));
    const found = mounts.devices(
      order.map((name) => ({
        ...CAR,
        name,
        dimensions: expected.dimensions.row(expected.names.indexOf(name)),
      })),
    );
    assert.equal(found.length, expected.devices.length);
    found.forEach((device, index) => {
      const { orientation, ...rest } = device,
        { orientation: right, ...others } = expected.devices[index];
      assert.deepEqual({ ...rest }, others);
      orientation.forEach((value, axis) =>
        assert.ok(Math.abs(value - right[axis]) <= 2 ** -52, `${device.name}: ${orientation}`),
      );
    });
  });
});

test("a device that keeps its heading is turned back against its object", () => {
  const spec = {
    name: "rx",
    kind: "antenna",
    role: "rx",
    on: "car",
    count: 1,
    mount: "roof",
    position_m: [0, 0, 0.5],
    yaw_deg: 90,
    pitch_deg: 0,
    roll_deg: 0,
    keeps_heading: true,
    power_dbm: 0,
    array: null,
  };
  const orientation = quaternion(0.7);
  const [device] = new Mounts([spec]).devices([{ ...CAR, orientation }]);
  const inWorld = multiply(orientation, device.orientation);
  quaternion(Math.PI / 2).forEach((value, axis) => assert.ok(Math.abs(inWorld[axis] - value) < 1e-15));
  assert.deepEqual(device.position, [0, 0, 1.25]);
});

test("patterns of devices match as the specification says", () => {
  for (const [pattern, name] of [
    ["car.*", "car.17"],
    ["*", ""],
    ["a*b*c", "a-b-b-c"],
    ["?", "é"],
    ["[abc]x", "bx"],
    ["[!a-c]", "d"],
    ["[[]", "["],
    ["[]]", "]"],
    ["a[", "a["],
    ["\\d", "\\d"],
    ["[\\]", "\\"],
    ["[a]", "[a]"],
    ["x[^]", "x^"],
  ]) {
    assert.ok(matches(pattern, name), `${pattern} matches ${name}`);
  }
  for (const [pattern, name] of [
    ["car.*", "Car.1"],
    ["?", ""],
    ["?", "ab"],
    ["[!a-c]", "b"],
    ["a*b", "ab.c"],
    ["\\d", "1"],
    ["[^a]", "b"],
  ]) {
    assert.ok(!matches(pattern, name), `${pattern} does not match ${name}`);
  }
});

test("objects are sorted by the UTF-8 bytes of their names", () => {
  const names = ["car.\u{1f600}", "car.\uffee", "car.10", "car", "car.2", "car.é"];
  const scene = sceneOf(
    names.map((name) => ({ ...CAR, name })),
    rules(),
  );
  assert.deepEqual(
    scene.names,
    [...names].sort((a, b) => Buffer.compare(Buffer.from(a), Buffer.from(b))),
  );
  assert.ok(byBytes("a", "ab") < 0 && byBytes("b", "ab") > 0 && byBytes("ü", "ü") === 0);
});

test("what no consumer would accept is named", () => {
  const wrong = [
    [{ name: "truck" }, /"truck" begins with none of the prefixes "car", "uav"/],
    [{ name: "car\n" }, /control characters/],
    [{ class: undefined }, /"car": class is undefined/],
    [{ position: [0, NaN, 0] }, /"car": position is \[0, NaN, 0\]; give it 3 finite numbers/],
    [{ position: [0, 0] }, /position/],
    [{ position: [2e9, 0, 0] }, /position is \[2000000000, 0, 0\]; stay within/],
    [{ velocity: undefined }, /"car": velocity is missing/],
    [{ velocity: [3e8, 0, 0] }, /light/],
    [{ angularVelocity: [0, 0, 1] }, /"car" has a field "angularVelocity"; its fields are name, .*angular_velocity/],
    [
      { orientation: [1, 0, 0, 1] },
      /orientation is \[1, 0, 0, 1\] of norm 1\.41.*unit quaternion \(w, x, y, z\)/,
    ],
    [{ dimensions: [4, 0, 1] }, /dimensions are \[4, 0, 1\]; give sides above 0/],
    [
      { mesh: "objects/car.ply" },
      /mesh is "objects\/car.ply", which was not offered; take it from what offerMesh returns/,
    ],
  ];
  for (const [change, told] of wrong)
    assert.throws(() => sceneOf([{ ...CAR, ...change }], rules()), { name: "SceneError", message: told });
  assert.throws(() => sceneOf([CAR, CAR], rules()), /two objects are named "car"/);
  assert.throws(
    () => sceneOf([CAR], rules({ devices: () => [{ name: "car", parent: "" }] })),
    /has the name of a device/,
  );
});

test("a scene says how objects turn only where one does", () => {
  assert.equal(sceneOf([CAR], rules()).angular_velocity, undefined);
  const turning = sceneOf(
    [
      { ...CAR, angular_velocity: [0, 0, 0.5] },
      { ...CAR, name: "uav" },
    ],
    rules(),
  ).angular_velocity;
  assert.deepEqual([...turning.data], [0, 0, 0.5, 0, 0, 0]);
});

test("a mesh in metres becomes one of the unit box, and says its size", () => {
  const assets = new Assets();
  const corners = [
    [0, -1, 0],
    [4, -1, 0],
    [4, 1, 0],
    [0, 1, 3],
  ];
  const mesh = assets.offerMesh("tent", corners, [
    [0, 2, 1],
    [0, 1, 3],
    [1, 2, 3],
    [2, 0, 3],
  ]);
  assert.deepEqual(mesh, { mesh: "objects/tent.ply", dimensions: [4, 2, 3], centre: [2, 0, 1.5] });
  const [{ size, digest }] = assets.listed;
  const { piece } = assets.piece(digest, 0);
  assert.equal(piece.length, size);
  const text = Buffer.from(piece).toString("latin1"),
    body = Buffer.from(piece).subarray(text.indexOf("end_header\n") + 11);
  assert.match(text, /^ply\nformat binary_little_endian 1.0\nelement vertex 4\n/);
  const read = Array.from({ length: 12 }, (_, index) => body.readFloatLE(4 * index));
  assert.deepEqual(read, [-0.5, -0.5, -0.5, 0.5, -0.5, -0.5, 0.5, 0.5, -0.5, -0.5, 0.5, 0.5]);
  assert.deepEqual(
    [body[48], body.readInt32LE(49), body.readInt32LE(53), body.readInt32LE(57)],
    [3, 0, 2, 1],
  );
  assert.equal(body.length, 48 + 4 * 13);
});

test("meshes and scenery that no consumer could read are named", () => {
  const assets = new Assets(),
    flat = [
      [0, 0, 0],
      [1, 0, 0],
      [1, 1, 0],
    ],
    face = [[0, 1, 2]];
  assert.throws(() => assets.offerMesh("sheet", flat, face), /mesh "sheet" is flat/);
  assert.throws(
    () =>
      assets.offerMesh(
        "hole",
        [
          [0, 0, 0],
          [1, 0, 0],
          [1, 1, 1],
        ],
        [[0, 1, 3]],
      ),
    /a triangle refers to vertex 3 of 3/,
  );
  assert.throws(() => assets.offerMesh("odd", [1, 2], face), /2 coordinates/);
  assert.throws(
    () =>
      assets.offerMesh(
        "../x",
        [
          [0, 0, 0],
          [1, 0, 0],
          [1, 1, 1],
        ],
        face,
      ),
    /relative path/,
  );
  const ground = { name: "ground", vertices: flat, triangles: face, material: "stone" };
  assert.throws(
    () => assets.offerScenery([ground], { stone: { type: "granite" } }),
    /type "granite"; choose one of .*concrete/,
  );
  assert.throws(
    () => assets.offerScenery([ground], { wall: { type: "brick" } }),
    /material "stone", which is none of wall/,
  );
  assert.throws(
    () => assets.offerScenery([{ ...ground, name: "mesh-a" }], { stone: { type: "brick" } }),
    /mesh-a/,
  );
  assert.throws(
    () => assets.offerScenery([ground, ground], { stone: { type: "brick" } }),
    /give each another name/,
  );
});

test("the geometry digest is that of the specification's example", () => {
  const assets = new Assets();
  assert.equal(assets.geometry, "");
  assets.offerFile("objects/car.ply", utf8("abc"));
  assert.equal(assets.geometry, "73fa00711059fde5a6e03da4536cd4d74471fe5a564563254a29a18b997479a8");
  assert.throws(() => assets.offerFile("objects/car.ply", utf8("abd")), /two different files/);
  assert.equal(sha256(utf8("abc")), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
});

test("floats stay floats, and no zero is negative", () => {
  assert.equal(Buffer.from(encode(new Float(-0))).toString("hex"), "cb0000000000000000");
  assert.equal(
    Buffer.from(encode([1, 1.5, new Float(1)])).toString("hex"),
    "9301cb3ff8000000000000cb3ff0000000000000",
  );
  const { body } = encodePayload("scene", sceneOf([{ ...CAR, position: [-0, 1, 2] }], rules()));
  assert.deepEqual([...body.subarray(0, 8)], [0, 0, 0, 0, 0, 0, 0, 0]);
});

test("three.js has the axes of Godot, and its models face +z", () => {
  const pose = {
    position: [1, 2, 3],
    orientation: quaternion(0.3, -0.2, 0.9),
    velocity: [4, 5, 6],
    angular_velocity: [7, 8, 9],
  };
  assert.deepEqual(THREE.fromEnu(pose), GODOT.fromEnu(pose));
  // Columns of the rotation: where x, and where z, points to.
  const forward = ([w, x, y, z]) => [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
  const facing = ([w, x, y, z]) => [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
  const { velocity: ahead } = THREE.fromEnu({ velocity: forward(pose.orientation) });
  facing(THREE_MODEL.fromEnu(pose).orientation).forEach((value, axis) =>
    assert.ok(Math.abs(value - ahead[axis]) < 1e-15),
  );
  facing(THREE.fromEnu(pose).orientation).forEach((value, axis) =>
    assert.ok(Math.abs(value + ahead[axis]) < 1e-15),
  );
  const back = THREE_MODEL.toEnu(THREE_MODEL.fromEnu(pose));
  for (const key of Object.keys(pose))
    back[key].forEach((value, axis) =>
      assert.ok(Math.abs(Math.abs(value) - Math.abs(pose[key][axis])) < 1e-14, key),
    );
  assert.deepEqual(wxyz(xyzw([1, 2, 3, 4])), [1, 2, 3, 4]);
});

test("sine and cosine are right to the last bit but one", () => {
  for (let i = -20000; i < 20000; i++) {
    const angle = i * 0.7368 + i * i * 1e-7;
    assert.ok(
      Math.abs(sin(angle) - Math.sin(angle)) <= 2 ** -52 &&
        Math.abs(cos(angle) - Math.cos(angle)) <= 2 ** -52,
      `${angle}`,
    );
  }
});

test("equal keys give equal random numbers, others others", () => {
  const numbers = (...keys) => Array.from({ length: 1000 }, generator(...keys));
  assert.deepEqual(numbers(7n, 0, "car"), numbers(7, 0, "car"));
  assert.notDeepEqual(numbers(7, 0, "car"), numbers(7, 1, "car"));
  const drawn = numbers(1);
  assert.ok(
    drawn.every((value) => value >= 0 && value < 1) &&
      Math.abs(drawn.reduce((a, b) => a + b) / 1000 - 0.5) < 0.05,
  );
});

/** A service as it is after WELCOME with these settings. */
function welcomed(service, settings = {}) {
  service.welcomed({
    run: "r",
    seed: 1n,
    settings,
    scenario: { devices: [], sampling_period_ns: 100_000_000 },
  });
  return service;
}

test("a state is the same after it was saved and taken over", async () => {
  const make = () =>
    Object.assign(welcomed(new World({ prefixes: ["car"] })), {
      save() {
        return this.kept;
      },
      restore(state) {
        this.kept = state;
      },
    });
  const first = make(),
    second = make();
  first.kept = {
    at: [1, 0.1, -2.5e-300],
    count: 3,
    name: "ü",
    deep: [{ a: null, b: true }],
    table: new Float64Array([1, 0.5]),
  };
  await second.restored(await first.saved());
  assert.deepEqual(second.kept, { ...first.kept, table: [1, 0.5] });
  await assert.rejects(
    second.restored(encode({ caviar: "agent", own: null, state: null })),
    /a state that no world/,
  );
});

const WEDGE = {
  vertices: [[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1]],
  triangles: [[0, 3, 2], [0, 2, 1], [0, 1, 4], [3, 5, 2], [0, 4, 5], [0, 5, 3], [1, 2, 5], [1, 5, 4]],
}; // prettier-ignore

/** A world in its first episode, which offers what `step` asks for, and what it said. */
async function spawning(step, { max_faces = 100, attempt = 1 } = {}) {
  const world = Object.assign(new World({ prefixes: ["car"] }), { step, said: [] });
  const scenario = { devices: [], sampling_period_ns: 100_000_000 };
  world.log = (line) => world.said.push(line);
  world.welcomed({ run: "r", seed: 1n, settings: {}, scenario, epoch: 1, attempt });
  await world.prepared({ max_faces });
  await world.began({ seed: 1n, t0_ns: 0n, seed_episode: 0 });
  world.frame = async (frame) => {
    const done = await world.answered({ frame, t_ns: 0n, previous_frame: frame - 1 }, []);
    const [{ header, body }] = done.products;
    return { ...done, scene: decodePayload("scene", header, body) };
  };
  return world;
}

test("a mesh that comes while the run goes on is announced, served, and goes after its objects", async () => {
  let shown = false;
  const world = await spawning(function () {
    const { mesh, dimensions } = shown ? this.offerMesh("car", WEDGE.vertices, WEDGE.triangles, "wood") : {};
    return [{ ...CAR, ...(shown && { mesh, dimensions }) }];
  });
  assert.equal((await world.frame(0)).geometry, undefined);
  shown = true;
  const { geometry, scene } = await world.frame(1);
  const [{ name, digest, size }] = geometry.assets;
  assert.equal(geometry.frame, 1);
  assert.deepEqual([name, scene.assets], [`objects/${digest}.ply`, [name]]);
  const { piece } = world.piece(digest, 0);
  assert.deepEqual([sha256(piece), piece.length], [digest, size]);
  assert.match(new TextDecoder().decode(piece), /^ply\n.*\ncomment material wood\n/);
  assert.equal((await world.frame(2)).geometry, undefined);
  shown = false;
  for (let frame = 3; frame <= 22; frame++) assert.equal((await world.frame(frame)).geometry, undefined);
  assert.deepEqual((await world.frame(23)).geometry, { frame: 23, assets: [] });
  assert.equal(world.piece(digest, 0), undefined);
});

test("a mesh that is none while the run goes on leaves a box, and is said once", async () => {
  const { vertices, triangles } = WEDGE;
  const wrong = [
    ["nan", [[NaN, 0, 0], ...vertices.slice(1)], triangles, /"nan": vertex 0 has the coordinate NaN/],
    ["none", vertices, [], /"none" has 0 corners/],
    ["many", vertices, Array(101).fill([0, 1, 2]), /"many" has 101 triangles, and this run takes 100/],
    ["flat", vertices.map(([x, y]) => [x, y, 0]), triangles, /"flat" is flat/],
  ];
  const world = await spawning(function () {
    return wrong.map(([name, points, corners]) => {
      const { mesh, dimensions } = this.offerMesh(name, points, corners);
      return { ...CAR, name: `car.${name}`, mesh, dimensions };
    });
  });
  for (const frame of [0, 1]) {
    const { geometry, scene } = await world.frame(frame);
    assert.equal(geometry, undefined);
    assert.deepEqual(scene.assets, ["", "", "", ""]);
  }
  assert.equal(world.said.length, wrong.length);
  wrong.forEach(([, , , told], index) => assert.match(world.said[index], told));
});

test("meshes are announced once more by a process that was started again, not where none may come", async () => {
  const step = function () {
    return [{ ...CAR, ...this.offerMesh("car", WEDGE.vertices, WEDGE.triangles) }];
  };
  const again = await spawning(() => [CAR], { attempt: 2 });
  assert.deepEqual((await again.frame(0)).geometry, { frame: 0, assets: [] });
  assert.equal((await again.frame(1)).geometry, undefined);
  const closed = await spawning(step, { max_faces: 0 });
  const { geometry, scene } = await closed.frame(0);
  assert.deepEqual([geometry, scene.assets], [undefined, [""]]);
  const world = await spawning(step);
  const [{ digest }] = (await world.frame(0)).geometry.assets;
  world.refused({ code: "refused-mesh", subject: digest });
  assert.deepEqual((await world.frame(1)).geometry, { frame: 1, assets: [] });
});

test("times count from frame 0 of their episode", async () => {
  const world = welcomed(new World({ prefixes: ["car"] }));
  for (const t0_ns of [0n, 5_000_000_000n]) {
    await world.began({ seed: 1n, t0_ns, seed_episode: 0 });
    assert.deepEqual(world.times({ t_ns: t0_ns, previous_frame: -1 }), [0, 0]);
    assert.deepEqual(world.times({ t_ns: t0_ns + 700_000_000n, previous_frame: 3 }), [0.7, 0.3]);
  }
});

test("rows of a mesh may be given one after the other, and what is none is refused by offerMesh", () => {
  const { vertices, triangles } = THREE.meshToEnu(new Float32Array([1, 2, 3, 4]), new Uint16Array([0, 1]));
  assert.deepEqual(vertices[0], [-3, -1, 2]);
  assert.throws(() => new Assets().offerMesh("car", vertices, triangles), /vertex 1 has the coordinate NaN/);
});

test("an agent owns what the scenario says, and gives one command for each actuator", async () => {
  const actuators = async (settings) => (await welcomed(new Agent(), settings).prepared({})).ready.actuators;
  assert.deepEqual(await actuators({}), ["beam:*"]);
  assert.deepEqual(await actuators({ users: ["car.*", "motion:uav"] }), ["beam:car.*", "motion:uav"]);
  assert.deepEqual(await actuators({ except_users: ["car.*"] }), []);
  const agent = welcomed(new Agent(), { except_users: ["beam:car.*"] });
  assert.ok(agent.serves("uav/rx") && !agent.serves("car.1/rx"));
  const beams = ["b", "a"].map((rx) => ({ type: "beam", tx: "bs", rx, tx_beam: 1 }));
  agent.step = () => [{ type: "velocity", object: "uav", velocity: [1, 0, 0] }, ...beams];
  const grant = { t_ns: 0n, previous_frame: -1, final: false };
  const {
    products: [{ header, body }],
  } = await agent.answered(grant, []);
  assert.deepEqual(
    decodePayload("action", header, body).commands.map((command) => command.rx ?? command.object),
    ["a", "b", "uav"],
  );
  agent.step = () => [...beams, beams[0]];
  await assert.rejects(agent.answered(grant, []), /two commands for beam:b, bs; give one/);
  agent.step = () => {
    agent.endEpisode();
    return [];
  };
  assert.equal((await agent.answered(grant, [])).end_episode, true);
  assert.deepEqual(await agent.answered({ ...grant, final: true }, []), { products: [] });
});

test("a gateway that is not there is named, and waiting for it can be ended", async () => {
  const world = new World({ prefixes: ["car"] }),
    nowhere = "ws://127.0.0.1:1/ws";
  await assert.rejects(world.run(nowhere, { patience: 0.1, log() {} }), {
    name: "RunError",
    message: /^ws:\/\/127.0.0.1:1\/ws does not answer/,
  });
  await assert.rejects(world.run("127.0.0.1:8080"), /is no address of a gateway; write ws:/);
  const told = [],
    waiting = world.run(nowhere, { patience: 60, log: (line) => told.push(line) });
  setTimeout(() => world.leave("the user went home"), 50);
  assert.equal(await waiting, "the user went home");
  assert.match(told.join("\n"), /^world: ws:.* does not answer .*; trying again for 60 s$/);
});
