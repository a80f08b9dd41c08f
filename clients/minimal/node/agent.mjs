// A whole agent, written from protocol/SPEC.md alone: node agent.mjs tcp://HOST:PORT NAME
import { createHash } from "node:crypto";
import { readFileSync } from "node:fs";
import { setTimeout as sleep } from "node:timers/promises";
import { decode, encode } from "@msgpack/msgpack";
import { Dealer } from "zeromq";
const [endpoint, name] = process.argv.slice(2);
const key = (variable, what) => // from the files that a broker with keys wants
  process.env[variable] && readFileSync(process.env[variable], "utf8").match(`${what} = "(.*)"`)[1];
const [publicKey, secretKey, curveServerKey] = [
  key("CAVIAR_KEY", "public"), key("CAVIAR_KEY", "secret"), key("CAVIAR_BROKER_KEY", "public")];
const curve = curveServerKey && { curvePublicKey: publicKey, curveSecretKey: secretKey, curveServerKey };
const broker = new Dealer({ linger: 1000, ...curve }); // [ms] at the end, so that a broker that is gone does not hold it up
let who = {}, turn = { episode: -1 }, stored = new Map(), kind = ""; broker.connect(endpoint);
const fail = (text) => { process.stderr.write(`${name}: ${text}\n`); process.exit(1); };

async function beat({ heartbeat_ns, liveness_ns }) { // nothing here takes long, so that no thread is needed
  process.on("SIGTERM", () => say({ type: "BYE", ...who }).then(() => process.exit(143)));
  const pulse = new Dealer({ linger: 0, ...curve, receiveTimeout: liveness_ns / 1e6 }); pulse.connect(endpoint);
  for (let sequence = -1; kind !== "SHUTDOWN"; sequence++) {
    await pulse.send(encode(sequence < 0 ? { type: "ATTACH", ...who, name } : { type: "HEARTBEAT", sequence }));
    const answer = decode((await pulse.receive().catch(() => [encode("no answer to a heartbeat")]))[0]);
    if (kind !== "SHUTDOWN" && answer.type !== "HEARTBEAT_ACK") fail(`from the broker came ${JSON.stringify(answer)}`);
    await sleep(heartbeat_ns / 1e6);
  }
}

function done(grant, parts) {
  const report = { type: "DONE", ...turn, frame: grant.frame };
  if (grant.final) return [encode(report)];
  const antennas = [], best = new Map(), commands = [], key = (tx, rx) => JSON.stringify([tx, rx]);
  const present = (grant.inputs ?? []).filter((input) => input.status !== "absent");
  if (parts.length !== 2 * present.length) fail(`${parts.length} parts for ${present.length} inputs`);
  present.forEach(({ topic }, index) => {
    const header = decode(parts[2 * index]), body = parts[2 * index + 1];
    const first = ({ offset, shape }, user) => body.readInt32LE(offset + 4 * shape[1] * user); // [user, 0]
    antennas.push(...(header.devices ?? []).filter((device) => device.type === "antenna"));
    if (topic === "link") header.rx.forEach((rx, user) => // of the frame before, the best pair of each user
      best.set(key(header.tx[user], rx), [header.top_tx_beam, header.top_rx_beam].map((top) => first(top, user))));
  });
  antennas.sort((a, b) => Buffer.compare(Buffer.from(a.name), Buffer.from(b.name)));
  for (const rx of antennas) for (const tx of antennas) if (rx !== tx && rx.role !== "tx" && tx.role !== "rx") {
    const [tx_beam, rx_beam] = best.get(key(tx.name, rx.name)) ?? [0, 0], beams = { tx_beam: Math.max(tx_beam, 0) };
    commands.push({ type: "beam", tx: tx.name, rx: rx.name, ...beams, ...(rx_beam > 0 && { rx_beam }) });
  }
  const payload = encode({ commands }), length = Buffer.alloc(8);
  length.writeBigUInt64LE(BigInt(payload.length));
  const digest = createHash("sha256").update(length).update(payload).digest("hex");
  return [encode({ ...report, products: [{ topic: "action", digest }] }), payload, Buffer.alloc(0)];
}
const say = (message) => broker.send(encode(message));
const inputs = [{ topic: "scene" }, { topic: "link", lag: 1, required: false }];
await say({ type: "HELLO", version: [1, 4], name, role: "agent", inputs, outputs: ["action"] });
while (kind !== "SHUTDOWN") {
  const [head, ...parts] = await broker.receive(), message = decode(head.subarray(0, 1 << 20)), { episode, frame } = message;
  kind = message.type;
  if (["REFUSE", "STALE", "ERROR"].includes(kind) || (message.version ?? [1])[0] !== 1)
    fail(`${kind}: ${message.message ?? JSON.stringify(message)}`);
  else if (kind === "WELCOME") { who = { epoch: message.epoch, attempt: message.attempt }; beat(message); }
  else if (kind === "PREPARE") await say({ type: "READY", ...who, actuators: ["beam:*"] });
  else if (kind === "RESET") { stored = new Map(); turn = { ...who, episode }; await say({ type: "RESET_DONE", ...turn }); }
  else if (kind === "GRANT" && Object.entries(turn).every(([key, value]) => message[key] === value))
    await broker.send(stored.get(frame) ?? stored.set(frame, done(message, parts)).get(frame));
  else if (!["CANCEL", "EPISODE_END", "SHUTDOWN"].includes(kind)) await say({ type: "ERROR", code: "unexpected", message: `${kind}` });
}
await say({ type: "BYE", ...who });
