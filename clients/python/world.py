"""A whole world, written from protocol/SPEC.md alone: python world.py tcp://HOST:PORT NAME

Objects go round in circles, come and leave: put a simulator in the place of `state`. Settings: see OBJECTS.
"""

import fnmatch, hashlib, itertools, math, os, pathlib, signal, struct, sys, threading, time, tomllib
import msgpack, zmq

ENDPOINT, NAME, LIMIT = *sys.argv[1:3], 1 << 20
IDS = ("epoch", "attempt", "episode")
OBJECTS = [  # on a circle around centre_m, from_s until before until_s; speed_m_s < 0 goes clockwise
    {"name": "car", "class": "car", "dimensions_m": [4.5, 1.8, 1.5],
     "centre_m": [0, 0, 0.75], "radius_m": 20, "speed_m_s": 10},
    {"name": "uav", "class": "uav", "dimensions_m": [0.6, 0.6, 0.25],
     "centre_m": [5, -5, 15], "radius_m": 8, "speed_m_s": -4},
]
unless = lambda value, standard: None if value == standard else value  # fields with their default stay out
given = lambda fields: {key: value for key, value in fields.items() if value is not None}
floats = lambda values: [float(value) + 0.0 for value in values]  # + 0.0: no −0
pack = lambda fields: msgpack.packb(given(fields))

def quaternion(yaw_deg, pitch_deg, roll_deg):  # z–y′–x″
    halves = [math.radians(angle) / 2 for angle in (yaw_deg, pitch_deg, roll_deg)]
    (cy, sy), (cp, sp), (cr, sr) = ((math.cos(half), math.sin(half)) for half in halves)
    return floats([cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr,
                   cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr])

def panel(at):
    angles = {key: unless(float(at[key]), 0.0) for key in ("yaw_deg", "pitch_deg", "roll_deg")}
    return given({"position_m": unless(floats(at["position_m"]), [0.0] * 3), **angles})

def device(spec, parent=None):  # of the scenario, in degrees, to one of the scene, in radians
    x, y, z = spec["position_m"]
    up = {"centre": 0.0, "roof": 0.5, "floor": -0.5}[spec["mount"]]
    z += up * parent["dimensions_m"][2] if parent else 0.0
    turned = quaternion(spec["yaw_deg"], spec["pitch_deg"], spec["roll_deg"])
    name = f"{parent['name']}/{spec['name']}" if parent else spec["name"]
    fields = {"type": spec["kind"], "name": name, "parent": parent and parent["name"],
              "position": unless(floats([x, y, z]), [0.0] * 3),
              "orientation": unless(turned, [1.0, 0.0, 0.0, 0.0])}
    if spec["kind"] == "antenna":
        array, standard = spec.get("array") or {}, {"rows": 1, "columns": 1, "vertical_spacing": 0.5,
            "horizontal_spacing": 0.5, "pattern": "iso", "polarization": "V"}
        file = array.get("pattern_file")
        kept = {key: unless(type(value)(array.get(key, value)), value) for key, value in standard.items()}
        array = kept | {
            "pattern_file": f"patterns/{file.split('/')[-1]}" if file else None,
            "panels": [panel(at) for at in array.get("panels") or []] or None}
        fields |= {"role": spec["role"], "array": given(array) or None,
                   "power_dbm": unless(float(spec["power_dbm"]), 0.0)}
    elif spec["kind"] == "lidar":
        (low, high), (near, far) = map(math.radians, spec["elevation_deg"]), spec["range_m"]
        fields |= {"beams": unless(spec["beams"], 64), "azimuth_steps": unless(spec["azimuth_steps"], 1800),
                   "elevation_min": unless(low, math.radians(-25)),
                   "elevation_max": unless(high, math.radians(3)),
                   "max_range": unless(float(far), 100.0), "min_range": unless(float(near), 0.0)}
    else:
        (width, height), angle = spec["size_px"], math.radians(spec["field_of_view_deg"])
        fields |= {"width": unless(width, 640), "height": unless(height, 480),
                   "field_of_view": unless(angle, math.pi / 2)}
    return given(fields)

def state(thing, t):  # position, orientation, velocity after t seconds of the episode
    (x, y, z), radius, speed = thing["centre_m"], thing["radius_m"], thing["speed_m_s"]
    angle = speed / radius * t
    heading = angle + math.copysign(math.pi / 2, speed)
    position = [x + radius * math.cos(angle), y + radius * math.sin(angle), z]
    velocity = [abs(speed) * math.cos(heading), abs(speed) * math.sin(heading), 0.0]
    return position, quaternion(math.degrees(heading), 0, 0), velocity

def done(grant, things, specs):
    t = (grant["t_ns"] - turn["t0_ns"]) / 1e9
    there = [o for o in things if o.get("from_s", 0) <= t < o.get("until_s", math.inf)]
    there.sort(key=lambda thing: thing.get("from_s", 0))
    found = []  # a pattern with a count is for the objects that came first
    for spec in specs:
        on = spec.get("on")
        carriers = [thing for thing in there if fnmatch.fnmatchcase(thing["name"], on)] if on else [None]
        found += [device(spec, thing) for thing in carriers[: spec.get("count")]]
    there.sort(key=lambda thing: thing["name"].encode())
    rows, body, fields = [(*state(thing, t), thing["dimensions_m"]) for thing in there], b"", {}
    columns = {"position": 3, "orientation": 4, "velocity": 3, "dimensions": 3}
    for index, (key, width) in enumerate(columns.items()):
        fields[key] = {"dtype": "<f8", "shape": [len(rows), width], "offset": len(body)}
        body += b"".join(struct.pack(f"<{width}d", *floats(row[index])) for row in rows)
    names, classes = ([thing[key] for thing in there] for key in ("name", "class"))
    devices = sorted(found, key=lambda device: device["name"].encode()) or None
    scene = {"names": names, "classes": classes, "assets": [""] * len(there), **fields, "devices": devices}
    header = pack(scene)
    digest = hashlib.sha256(len(header).to_bytes(8, "little") + header + body).hexdigest()
    ids = {key: turn[key] for key in IDS}
    products = [{"topic": "scene", "digest": digest}]
    return [pack({"type": "DONE", **ids, "frame": grant["frame"], "products": products}), header, body]

def dealer(context):  # a broker with keys wants the files that two environment variables name
    socket = context.socket(zmq.DEALER)
    if os.environ.get("CAVIAR_KEY"):
        files = ("CAVIAR_KEY", "CAVIAR_BROKER_KEY")
        own, broker = (tomllib.loads(pathlib.Path(os.environ[file]).read_text()) for file in files)
        socket.curve_publickey, socket.curve_secretkey = own["public"].encode(), own["secret"].encode()
        socket.curve_serverkey = broker["public"].encode()
    socket.connect(ENDPOINT)
    return socket

def beat(welcome):
    pulse, attach = dealer(zmq.Context()), {"type": "ATTACH", **who, "name": NAME}
    for sequence in itertools.count(-1):
        pulse.send(pack(attach if sequence < 0 else {"type": "HEARTBEAT", "sequence": sequence}))
        answer = msgpack.unpackb(pulse.recv()) if pulse.poll(welcome["liveness_ns"] / 1e6) else {}
        if answer.get("type") != "HEARTBEAT_ACK":
            raise RuntimeError(f"from the broker came {answer or 'no answer to a heartbeat'}")
        time.sleep(welcome["heartbeat_ns"] / 1e9)

def read(parts):  # the message, or an empty one where it is none
    try:
        message = msgpack.unpackb(parts[0][: LIMIT + 1])
        inputs = message.get("inputs", []) if message["type"] == "GRANT" else []
        follow = 2 * sum(entry["status"] != "absent" for entry in inputs)
        return message if len(parts) == 1 + follow and isinstance(message["type"], str) else {}
    except (ValueError, TypeError, KeyError, AttributeError, msgpack.UnpackException):
        return {}

threading.excepthook = lambda end: os._exit(os.write(2, f"{NAME}: {end.exc_value!r}\n".encode()) and 1)
leaving = set()  # by SIGTERM, which may come amid the parts of a message
turn, who, message = {}, {}, {}
with zmq.Context() as context, dealer(context) as broker:
    broker.linger = 1000  # [ms]
    hello = {"name": NAME, "role": "world", "outputs": ["scene"], "capabilities": ["episodes"]}
    broker.send(pack({"type": "HELLO", "version": [1, 4], **hello}))
    while message.get("type") != "SHUTDOWN" and not leaving:
        if not broker.poll(100):  # [ms], as a signal need not end the wait
            continue
        message = read(broker.recv_multipart())
        match message.get("type"):
            case kind if kind == "REFUSE" or message.get("version", [1])[0] != 1:
                sys.exit(f"{NAME}: {kind}: {message.get('message', message)}")
            case "WELCOME":
                who = {key: message[key] for key in ("epoch", "attempt")}
                things = message.get("settings", {}).get("objects", OBJECTS)
                specs = message.get("scenario", {}).get("devices", [])
                signal.signal(signal.SIGTERM, lambda *_: leaving.add(143))
                threading.Thread(target=beat, args=[message], daemon=True).start()
            case "PREPARE":
                fixed = [spec for spec in specs if not spec.get("on")]
                names = [thing["name"] for thing in [*things, *fixed]]
                broker.send(pack({"type": "READY", **who, "prefixes": sorted({*names}, key=str.encode)}))
            case "ASSET_GET":  # boxes in free space: nothing was offered
                answer = {"code": "unknown-asset", "message": "no such asset"}
                broker.send(pack({"type": "ERROR", **answer, "subject": message.get("digest")}))
            case "RESET":
                turn, stored = {**who, "episode": message["episode"], "t0_ns": message["t0_ns"]}, {}
                broker.send(pack({"type": "RESET_DONE", **who, "episode": message["episode"]}))
            case "GRANT" if turn and all(message[key] == turn[key] for key in IDS):
                stored[message["frame"]] = stored.get(message["frame"]) or done(message, things, specs)
                broker.send_multipart(stored[message["frame"]])
            case "STALE" | "ERROR" as kind:
                print(f"{NAME}: {kind}: {message}", file=sys.stderr)
            case kind if kind not in ("CANCEL", "EPISODE_END", "SHUTDOWN"):
                code = "unexpected" if kind else "malformed"
                broker.send(pack({"type": "ERROR", "code": code, "message": f"cannot be used: {kind}"}))
    sys.exit(broker.send(pack({"type": "BYE", **who})) or max(leaving, default=0))
