// The reference agent: for each receiver that the scenario leaves to it, the pair of beams that was best in
// the frame before. In Node: node agent.mjs ws://HOST:PORT/ws NAME.
import { Agent, main } from "./src/index.mjs";

class Follower extends Agent {
  step(t, previous, inputs) {
    const best = new Map();
    for (const { topic, payload } of inputs) {
      if (topic !== "link" || !payload?.top_tx_beam.shape[1]) continue;
      payload.rx.forEach((rx, user) => {
        const pair = [payload.top_tx_beam.at(user, 0), payload.top_rx_beam.at(user, 0)];
        if (pair[0] >= 0) best.set(JSON.stringify([payload.tx[user], rx]), pair); // −1: the user has no path
      });
    }
    const devices = inputs.flatMap(({ topic, payload }) => (topic === "scene" && payload?.devices) || []);
    const antennas = devices.filter(({ type }) => type === "antenna");
    return antennas.filter(({ role, name }) => role !== "tx" && this.serves(name)).flatMap((rx) =>
      antennas.filter((tx) => tx !== rx && tx.role !== "rx").map((tx) => {
        const [tx_beam, rx_beam] = best.get(JSON.stringify([tx.name, rx.name])) ?? [0, 0];
        return { type: "beam", tx: tx.name, rx: rx.name, tx_beam, rx_beam };
      }));
  }
}

main(new Follower());
