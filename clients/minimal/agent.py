"""A whole agent, written from protocol/SPEC.md alone: python agent.py tcp://HOST:PORT NAME"""
import hashlib, itertools, os, pathlib, signal, struct, sys, threading, time, tomllib, msgpack, zmq
ENDPOINT, NAME, INPUTS = *sys.argv[1:3], [{"topic": "scene"}, {"topic": "link", "lag": 1, "required": False}]
message = {"version": [1, 4], "name": NAME, "role": "agent", "inputs": INPUTS, "outputs": ["action"]}

def dealer(context):  # a broker with keys wants the files that two environment variables name
    socket, variables = context.socket(zmq.DEALER), ("CAVIAR_KEY", "CAVIAR_BROKER_KEY")
    if os.environ.get("CAVIAR_KEY"):
        own, broker = (tomllib.loads(pathlib.Path(os.environ[file]).read_text()) for file in variables)
        socket.curve_publickey, socket.curve_secretkey = own["public"].encode(), own["secret"].encode()
        socket.curve_serverkey = broker["public"].encode()
    socket.connect(ENDPOINT)
    return socket

def beat(welcome):
    pulse, attach = dealer(zmq.Context()), {"type": "ATTACH", **who, "name": NAME}
    for sequence in itertools.count(-1):
        pulse.send(msgpack.packb(attach if sequence < 0 else {"type": "HEARTBEAT", "sequence": sequence}))
        answer = msgpack.unpackb(pulse.recv()) if pulse.poll(welcome["liveness_ns"] / 1e6) else {}
        if answer.get("type") != "HEARTBEAT_ACK":
            raise RuntimeError(f"from the broker came {answer or 'no answer to a heartbeat'}")
        time.sleep(welcome["heartbeat_ns"] / 1e9)

def done(grant, parts):
    report, antennas, best, commands = {"type": "DONE", **turn, "frame": grant["frame"]}, [], {}, []
    topics = [entry["topic"] for entry in grant["inputs"] if entry["status"] != "absent"]
    for topic, header, body in zip(topics, map(msgpack.unpackb, parts[::2]), parts[1::2], strict=True):
        antennas += [device for device in header.get("devices", []) if device["type"] == "antenna"]
        if topic == "link":  # of the frame before: [:, 0] of these lists is the best pair of each user
            beams = [struct.unpack_from(f"<{users * k}i", body, header[key]["offset"])[:: k or 1]
                     for key in ("top_tx_beam", "top_rx_beam") for users, k in [header[key]["shape"]]]
            best = {(row[0], row[1]): row[2:] for row in zip(header["tx"], header["rx"], *beams, strict=True)}
    for rx, tx in itertools.product(sorted(antennas, key=lambda antenna: antenna["name"]), repeat=2):
        if rx is not tx and rx["role"] != "tx" and tx["role"] != "rx":
            tx_beam, rx_beam = best.get((tx["name"], rx["name"]), (0, 0))
            beams = {"tx_beam": max(tx_beam, 0)} | ({"rx_beam": rx_beam} if rx_beam > 0 else {})
            commands.append({"type": "beam", "tx": tx["name"], "rx": rx["name"], **beams})
    payload = msgpack.packb({"commands": commands})
    digest = hashlib.sha256(len(payload).to_bytes(8, "little") + payload).hexdigest()
    product = {"products": [{"topic": "action", "digest": digest}]}
    return [msgpack.packb(report)] if grant.get("final") else [msgpack.packb(report | product), payload, b""]

threading.excepthook = lambda end: os._exit(os.write(2, f"{NAME}: {end.exc_value!r}\n".encode()) and 1)
leaving = set()  # by SIGTERM, which may come amid the parts of a message: BYE goes after them, from the loop
with zmq.Context() as context, dealer(context) as broker:
    broker.linger = 1000  # [ms] at the end, so that a broker that is gone does not hold it up
    broker.send(msgpack.packb({"type": "HELLO", **message}))
    while message.get("type") != "SHUTDOWN" and not leaving:
        if not broker.poll(100):  # [ms], as a signal need not end the wait
            continue
        header, *parts = broker.recv_multipart()
        match (message := msgpack.unpackb(header[: 1 << 20]))["type"]:
            case kind if kind in ("REFUSE", "STALE", "ERROR") or message.get("version", [1])[0] != 1:
                sys.exit(f"{NAME}: {kind}: {message.get('message', message)}")
            case "WELCOME":
                turn = {"episode": -1, **(who := {key: message[key] for key in ("epoch", "attempt")})}
                signal.signal(signal.SIGTERM, lambda *_: leaving.add(143))
                threading.Thread(target=beat, args=[message], daemon=True).start()
            case "PREPARE":
                broker.send(msgpack.packb({"type": "READY", **who, "actuators": ["beam:*"]}))
            case "RESET":
                turn, stored = {**who, "episode": message["episode"]}, {}
                broker.send(msgpack.packb({"type": "RESET_DONE", **turn}))
            case "GRANT" if message.items() >= turn.items():
                stored[message["frame"]] = stored.get(message["frame"]) or done(message, parts)
                broker.send_multipart(stored[message["frame"]])
            case kind if kind not in ("CANCEL", "EPISODE_END", "SHUTDOWN"):
                broker.send(msgpack.packb({"type": "ERROR", "code": "unexpected", "message": str(kind)}))
    sys.exit(broker.send(msgpack.packb({"type": "BYE", **who})) or max(leaving, default=0))
