// A whole CAVIAR agent, from protocol/SPEC.md alone: it takes the beam pairs that were best a frame ago.
import { createHash } from "node:crypto"
import { decode, encode } from "@msgpack/msgpack"
import { Dealer } from "zeromq"

const [url, name] = process.argv.slice(2)
const broker = new Dealer({ linger: 500 }), heart = new Dealer({ linger: 0 })
let ids = {}, answers = new Map(), heard = performance.now(), patience = 30_000

const send = (socket, type, fields, ...parts) => socket.send([encode({ type, ...ids, ...fields }), ...parts])

async function beat(every) { // on a connection of its own (clause 2)
  heart.connect(url)
  await send(heart, "ATTACH", { name })
  let sequence = 0
  setInterval(() => send(heart, "HEARTBEAT", { sequence: sequence++, progress: answers.size }), every)
  for await (const _ of heart) heard = performance.now()
}

function best(link, body, key) { // an array <i4 [users, K]: the first of each user's list
  const { shape: [users, listed], offset } = link[key]
  return Array.from({ length: users }, (_, u) => body.readInt32LE(offset + 4 * u * listed))
}

function decide({ inputs, final }, parts) {
  const topics = inputs.filter(i => i.status !== "absent").map(i => i.topic)
  const [l, s] = ["link", "scene"].map(topic => 2 * topics.indexOf(topic))
  if (l < 0 || final) return []
  const link = decode(parts[l]), here = new Set(decode(parts[s]).devices.map(device => device.name))
  const [tx_beams, rx_beams] = ["top_tx_beam", "top_rx_beam"].map(key => best(link, parts[l + 1], key))
  return link.rx.map((rx, u) => ({ type: "beam", tx: link.tx[u], rx, tx_beam: tx_beams[u],
    ...(rx_beams[u] > 0 && { rx_beam: rx_beams[u] }), carrier: link.carrier[u] }))
    .filter(c => c.tx_beam >= 0 && here.has(c.tx) && here.has(c.rx))
    .sort((a, b) => ["rx", "tx", "carrier"].map(k => Buffer.compare(Buffer.from(a[k]), Buffer.from(b[k]))).find(o => o) ?? 0)
}

function answer(got, parts) {
  const action = Buffer.from(encode({ commands: decide(got, parts) })), size = Buffer.alloc(8)
  size.writeBigUInt64LE(BigInt(action.length))
  const digest = createHash("sha256").update(size).update(action).digest("hex")
  return got.final ? [[]] : [[{ topic: "action", digest }], action, Buffer.alloc(0)]
}

const leave = why => { if (why) console.error(why); process.exit(why ? 1 : 0) }
setInterval(() => performance.now() > heard + patience && leave(`the broker at ${url} is silent`), 100)
broker.connect(url)
await send(broker, "HELLO", { version: [1, 1], name, role: "agent", outputs: ["action"],
  inputs: [{ topic: "scene" }, { topic: "link", lag: 1, required: false }] })
for await (const [header, ...parts] of broker) {
  const got = decode(header), { type, episode, frame } = got
  if (type === "WELCOME") {
    ids = { epoch: got.epoch, attempt: got.attempt }
    patience = got.liveness_ns / 1e6
    beat(got.heartbeat_ns / 1e6)
  } else if (type === "PREPARE") await send(broker, "READY", { actuators: ["beam:*"] })
  else if (type === "RESET") { answers.clear(); await send(broker, "RESET_DONE", { episode }) }
  else if (type === "GRANT") { // a repeated GRANT gets the stored DONE (clause 7)
    if (!answers.has(frame)) answers.set(frame, answer(got, parts))
    const [products, ...made] = answers.get(frame)
    await send(broker, "DONE", { episode, frame, products }, ...made)
  } else if (type === "REFUSE") leave(got.message)
  else if (type === "SHUTDOWN") { await send(broker, "BYE", {}); setTimeout(leave, 100) }
}
