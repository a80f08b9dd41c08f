"""A whole CAVIAR agent, from protocol/SPEC.md alone: it takes the beam pairs that were best a frame ago."""
import hashlib, struct, sys, threading, time
import msgpack, zmq

url, name = sys.argv[1:3]
context, over, ids, answers, why = zmq.Context(), threading.Event(), {}, {}, f"no broker answers at {url}"
broker, heart = context.socket(zmq.DEALER), context.socket(zmq.DEALER)
def send(socket, kind, *parts, **fields):
    socket.send_multipart([msgpack.packb({"type": kind, **ids, **fields}), *parts])
def beat(every, liveness):  # in a thread and on a connection of its own (clause 2)
    heart.connect(url)
    send(heart, "ATTACH", name=name)
    heard, sequence = time.monotonic(), 0
    while time.monotonic() < heard + liveness and not over.is_set():
        send(heart, "HEARTBEAT", sequence=(sequence := sequence + 1), progress=len(answers))
        while heart.poll(1000 * every):
            heard, _ = time.monotonic(), heart.recv()
    over.set()
def best(link, body, key):  # an array <i4 [users, K]: the first of each user's list
    users, listed = link[key]["shape"]
    return struct.unpack_from(f"<{users * listed}i", body, link[key]["offset"])[::listed]
def decide(grant, parts):
    topics = [i["topic"] for i in grant["inputs"] if i["status"] != "absent"]
    if "link" not in topics or grant.get("final"):
        return []
    link, scene = (msgpack.unpackb(parts[2 * topics.index(topic)]) for topic in ("link", "scene"))
    beams = [best(link, parts[2 * topics.index("link") + 1], key) for key in ("top_tx_beam", "top_rx_beam")]
    users, here = zip(link["rx"], link["tx"], link["carrier"], *beams), {d["name"] for d in scene["devices"]}
    return [{"type": "beam", "tx": t, "rx": r, "tx_beam": i} | ({"rx_beam": j} if j else {}) | {"carrier": c}
            for r, t, c, i, j in sorted(users) if i >= 0 and {t, r} <= here]

broker.connect(url)
send(broker, "HELLO", version=[1, 1], name=name, role="agent", outputs=["action"],
     inputs=[{"topic": "scene"}, {"topic": "link", "lag": 1, "required": False}])
give_up = time.monotonic() + 30
while not over.is_set() and (ids or time.monotonic() < give_up):
    if not broker.poll(100):
        continue
    header, *parts = broker.recv_multipart()
    got = msgpack.unpackb(header)
    if got["type"] == "WELCOME":
        ids = {"epoch": got["epoch"], "attempt": got["attempt"]}
        threading.Thread(target=beat, args=(got["heartbeat_ns"] / 1e9, got["liveness_ns"] / 1e9)).start()
    elif got["type"] == "PREPARE":
        send(broker, "READY", actuators=["beam:*"])
    elif got["type"] == "RESET":
        answers.clear()
        send(broker, "RESET_DONE", episode=got["episode"])
    elif got["type"] == "GRANT":
        if got["frame"] not in answers:  # a repeated GRANT gets the stored DONE (clause 7)
            action = msgpack.packb({"commands": decide(got, parts)})
            digest = hashlib.sha256(struct.pack("<Q", len(action)) + action).hexdigest()
            products = [] if got.get("final") else [{"topic": "action", "digest": digest}]
            answers[got["frame"]] = products, [action, b""][: 2 * len(products)]
        products, made = answers[got["frame"]]
        send(broker, "DONE", *made, episode=got["episode"], frame=got["frame"], products=products)
    elif got["type"] in ("REFUSE", "SHUTDOWN"):
        why = got["message"] if got["type"] == "REFUSE" else send(broker, "BYE")
        over.set()
sys.exit(why)
