# A world of a CAVIAR run over WebSocket: extend this script, override `step`, and call `poll` in every tick.
#
#     extends "res://addons/caviar/caviar_world.gd"
#
#     func step(t, previous, commands):
#         return [object("car", "car", [10.0 * t, 0.0, 0.75], [4.5, 1.8, 1.5])]
#
# Poses are right-handed, in metres, z up, with x forward; Axes converts those of engines. The protocol is
# protocol/SPEC.md of the project. SPDX-License-Identifier: Apache-2.0

const Axes = preload("caviar_axes.gd")
const Codec = preload("caviar_codec.gd")
const Heart = preload("caviar_heart.gd")
const Products = preload("caviar_products.gd")
const RunTimeMeshes = preload("caviar_run_time_meshes.gd")
const Scene = preload("caviar_scene.gd")
const Scenery = preload("caviar_scenery.gd")

const WAIT = "wait"  # what `step` returns to be asked again in the next tick
const SMALLEST_M = 0.01  # [m] side of the box of a mesh that is refused and has none
const DIGESTED_BYTES = 16 << 10
const STATE_MARK = "caviar-world-1"
enum { CONNECTING, JOINED, PREPARING, READY, ACTIVE, OVER }

var settings = {}  # of the world, from the scenario
var scenario = {}  # what concerns all services
var prefixes = []  # of the names of objects; those of fixed devices are added by themselves
var inputs = []  # topics that the world wants to see, of the frame before: set it before `connect_to`
var products = {}  # of this frame: topic to a list of decoded ones
var implementation = "caviar-godot"
var patience_ms = 120000  # to wait for WELCOME
var buffer_kb = 4096  # of a message that comes, at most
var name = ""
var frame = -1
var episode = 0
var seed_episode = 0
var exit_status = 0
var end_reason = ""

var _codec = Codec.new()
var _scenery = Scenery.new()
var _meshes = RunTimeMeshes.new()
var _said = {}
var _scene
var _socket_script
var _socket
var _heart
var _url = ""
var _token = ""
var _state = OVER
var _grants = []
var _answers = {}
var _fault = ""
var _faulted = false
var _epoch = 0
var _attempt = 0
var _deadline = 0
var _retry_at = 0
var _pause = 0
var _rejoin_ms = 0
var _rejoin_until = 0
var _t0 = 0
var _previous = 0
var _newest = -1
var _stepped = false


func _init():
	var major = Engine.get_version_info()["major"]
	_socket_script = load(Codec.new().get_script().resource_path.get_base_dir() + "/caviar_socket_%d.gd" % major)


# --- what a world overrides ---------------------------------------------------------------------------------


# Load, offer meshes and scenery, and add to prefixes; settings and scenario are there.
func prepare():
	pass


# Go to the first state. Everything random follows from the seed, seed_episode and the frame. t0: of frame 0
# [s].
func reset(_seed, _t0_s):
	pass


# The objects at t [s of the episode]; previous is the time of the frame completed last, t itself for the
# first.
func step(_t, _previous_t, _commands):
	return []


# Bytes of the state after the last frame; empty where frames follow from time, seed and settings alone.
func save():
	return Codec.utf8("")


func restore(_bytes):
	pass


# --- what a world may use -----------------------------------------------------------------------------------


func object(object_name, kind, position, dimensions):
	return Scene.object(object_name, kind, position, dimensions)


# {mesh, dimensions, centre}: what an object with this mesh has as `mesh` and `dimensions` [m], and where the middle
# of its box, its `position`, is in the mesh's own axes. In `prepare` it is there for the whole run. In `reset`, `step` and
# `restore` it comes while the run goes on, and stays as long as an object has it, and 20 frames longer, until the
# episode ends; a state has no meshes, so that `restore` offers those of its objects again. One that is none is
# printed then, and its `mesh` is empty: its objects are boxes.
func offer_mesh(mesh_name, vertices, triangles, material = ""):
	var offered = Scenery.box_of(vertices)
	offered["mesh"] = ""
	if _state != READY and _state != ACTIVE:
		offered["mesh"] = _scenery.offer_mesh(mesh_name, vertices, triangles, material)
		return offered
	var wrong = Scenery.wrong_at_run_time(mesh_name, vertices, triangles, _meshes.max_faces)
	_scenery.problem = ""
	var file = _scenery.unit_mesh(mesh_name, vertices, triangles, material) if wrong == "" else null
	if wrong == "":
		wrong = _scenery.problem
	if wrong == "":
		offered["mesh"] = _meshes.add(file)
		return offered
	_say(wrong + "; objects with it are boxes")
	for i in range(3):
		if offered["dimensions"][i] < SMALLEST_M:
			offered["dimensions"][i] = SMALLEST_M
	return offered


func _say(line):
	if not _said.has(line):
		printerr("%s: %s" % [name, line])
	_said[line] = true


func offer_scenery(meshes, materials, scenery_name = "world"):
	return _scenery.offer_scenery(meshes, materials, scenery_name)


func offer_file(file_name, bytes):
	return _scenery.offer(file_name, bytes)


# Numbers, texts, lists and dictionaries as bytes, for `save`, and back, for `restore`; floats stay exact.
func var_to_state(value):
	return _codec.pack(value)


func state_to_var(bytes):
	return _codec.unpack(bytes)


# Say that the frame, or what is being prepared, cannot be: the run ends with this message.
func fail(why):
	if _fault == "":
		_fault = why


# --- life ---------------------------------------------------------------------------------------------------


# Begin to join the run; returns at once. url: ws://HOST:PORT/ws, the gateway of `caviar run --http`.
func connect_to(url, world_name, token = ""):
	_url = url
	_token = token
	name = world_name
	exit_status = 0
	_faulted = false
	_epoch = 0
	if url.begins_with("ws://") or url.begins_with("wss://"):
		_join(patience_ms)
	else:
		_end(1, "'%s' is no address of a gateway; write ws://HOST:PORT/ws" % url)


# Handle what came, at most one frame; false once the world has left. Never waits.
func poll():
	if _state == OVER:
		return false
	var stop_file = OS.get_environment("CAVIAR_STOP_FILE")
	if stop_file != "" and _socket_script.file_exists(stop_file):
		_leave(143, "SIGTERM")
		return false
	if _socket == null:
		if _now() >= _retry_at:
			_join(_deadline - _now() if _now() < _deadline else 5000)
		return true
	_socket.poll()
	if _heart != null:
		_heart.poll()
	var bytes = _socket.receive() if _grants.size() == 0 else null
	while bytes != null:
		_receive(bytes)
		bytes = _socket.receive() if _socket != null and _grants.size() == 0 else null
	if _socket != null and _grants.size() > 0:
		_answer()
	elif _socket != null:
		_watch()
	return _state != OVER


# Leave the run: call it where the engine closes. The run may wait for the world to come back.
func close():
	if _state != OVER:
		_leave(0, "closed")


func _now():
	return _socket_script.ticks_ms()


func _join(patience):
	_state = CONNECTING
	_grants = []
	_deadline = _now() + patience
	_socket = _socket_script.new()
	_socket.open(_url, _token, buffer_kb)
	var declared = []
	for topic in inputs:
		declared.append({"topic": topic, "lag": 1, "required": false})
	_send("HELLO", {
		"version": [1, 6], "name": name, "role": "world", "inputs": declared, "outputs": ["scene"],
		"capabilities": ["assets", "episodes", "checkpoint", "geometry"], "implementation": implementation,
		"max_in_flight": 4,
	})


# Whether the connection, the broker or the time is lost.
func _watch():
	if _socket.is_closed() and _state == CONNECTING and _now() < _deadline:
		# The gateway may listen seconds after the broker started: until then connections are refused.
		_socket.abort()
		_socket = null
		_retry_at = _now() + 500
	elif _socket.is_closed():
		_lose("cannot reach %s" % _url if _state == CONNECTING else "the connection is lost")
	elif _state == CONNECTING and _now() > _deadline:
		_lose("no WELCOME")
	elif _heart != null and _heart.lost != "":
		_lose(_heart.lost)


# The broker is lost: come back within the time that WELCOME gave, or end.
func _lose(why):
	if _state != CONNECTING:
		_rejoin_until = _now() + _rejoin_ms
		_pause = 100
		printerr("%s: %s" % [name, why])
	_disconnect()
	if _epoch == 0 or _now() >= _rejoin_until:
		_end(1, why)
		return
	_state = CONNECTING
	_pause = min(1000, 2 * _pause)
	_retry_at = _now() + _pause
	_deadline = 0


func _disconnect():
	if _heart != null:
		_heart.stop()
	if _socket != null:
		_socket.abort()
	_heart = null
	_socket = null


func _leave(status, reason):
	if _heart != null:
		_heart.stop()
	_heart = null
	if _socket != null and _epoch > 0 and _state != CONNECTING:
		_send("BYE", _mine({"reason": reason}))
	if _socket != null:
		_socket.close()
	_socket = null
	_end(status, reason)


func _end(status, reason):
	_state = OVER
	exit_status = 1 if status == 0 and _faulted else status
	end_reason = reason
	printerr("%s: %s" % [name, reason])


func _frame(type, fields, parts = []):
	return Codec.join_frame([_codec.encode_message(type, fields)] + parts)


func _send(type, fields, parts = []):
	_socket.send(_frame(type, fields, parts))


func _error(code, why, of = "", subject = ""):
	_send("ERROR", {"code": code, "message": why, "of": of, "subject": subject})


func _mine(fields):
	fields["epoch"] = _epoch
	fields["attempt"] = _attempt
	return fields


# --- messages -----------------------------------------------------------------------------------------------


func _receive(bytes):
	var parts = _codec.split_frame(bytes)
	var fields = _codec.decode_message(parts[0]) if parts != null else null
	if fields != null and not _codec.check_parts(fields, parts):
		fields = null
	if fields == null and _codec.code == "version":
		_disconnect()
		_end(1, _codec.message)
	elif fields == null:
		_error(_codec.code, _codec.message)
	else:
		if _heart != null:
			_heart.progress += 1
		_take(fields["type"], fields, parts)


func _take(type, fields, parts):
	if type == "SHUTDOWN" and _state != CONNECTING:
		# A reason that blames a service begins with its role and name.
		_leave(int(fields["reason"].begins_with("world '%s' " % name)), fields["reason"])
	elif type == "REFUSE" and _state == CONNECTING:
		_refused(fields)
	elif type == "STALE" or type == "ERROR":
		printerr("%s: %s %s %s" % [name, type, fields.get("code", fields["of"]), fields.get("message", "")])
		if fields.get("code", "") == "refused-mesh":
			_meshes.refuse(fields["subject"])
	elif type == "CANCEL":
		pass  # advice: the answer is due all the same
	elif type == "ASSET_GET" and _state > JOINED:
		_serve(fields)
	elif not _is_due(type, fields):
		_error("unexpected", "this %s is not due" % type, type)
	elif type == "WELCOME":
		_welcome(fields)
	elif type == "PREPARE":
		_on_prepare(fields)
	elif type == "RESET":
		_on_reset(fields)
	elif type == "GRANT":
		_grants.append([fields, parts])
	elif type == "EPISODE_END":
		_state = READY
	elif type == "CHECKPOINT":
		_send("CHECKPOINT_DONE", _mine({"episode": episode, "frame": fields["frame"]}), [_saved()])
	elif type == "RESTORE":
		_on_restore(parts[1])


func _is_due(type, fields):
	if type == "WELCOME":
		return _state == CONNECTING
	if not fields.has("epoch") or fields["epoch"] != _epoch or fields["attempt"] != _attempt:
		return false
	if type == "PREPARE":
		return _state == JOINED
	if type == "RESET":
		return _state == READY or _state == ACTIVE
	var known = type in ["GRANT", "CHECKPOINT", "EPISODE_END", "RESTORE"]
	return known and _state == ACTIVE and fields["episode"] == episode


func _refused(fields):
	var why = "%s: %s" % [fields["code"], fields["message"]]
	# Coming back: the broker may not know yet that the connection before is gone.
	if _epoch > 0 and fields["code"] == "name-taken":
		_lose(why)
		return
	_disconnect()
	_end(1, why)


func _welcome(fields):
	_epoch = fields["epoch"]
	_attempt = fields["attempt"]
	_rejoin_ms = fields["rejoin_ns"] / 1000000
	settings = fields["settings"]
	scenario = fields["scenario"]
	_scene = Scene.new(_codec, scenario.get("devices", []))
	_scene.scenery = _scenery
	_heart = Heart.new(Codec.new(), _socket_script.new(), fields)
	_heart.begin(_url, _token, _epoch, _attempt, name)
	_state = JOINED


func _on_prepare(fields):
	_state = PREPARING
	_meshes.max_faces = fields["max_faces"]
	_heart.phase = "prepare"
	_scenery.clear()
	prefixes = []
	_fault = ""
	prepare()
	if _scenery.problem != "":
		fail(_scenery.problem)
	if _fault != "":
		_socket.send(_fault_frame(-1, "prepare", ""))
		return
	var all = {}
	for prefix in prefixes + _scene.fixed_names():
		all[prefix] = true
	_scene.prefixes = all.keys()
	_scene.prefixes.sort()
	if _scenery.entries().size() > 0:
		_send("ASSET_OFFER", _mine({"assets": _scenery.entries()}))
	_send("READY", _mine({"geometry": _scenery.geometry(), "prefixes": _scene.prefixes}))
	_state = READY


func _serve(fields):
	var data = _scenery.find(fields["digest"])
	if data == null:
		data = _meshes.find(fields["digest"])
	var offset = fields["offset"]
	if data == null or offset > data.size():
		_error("unknown-asset", "no asset has this digest, or it ends before", "ASSET_GET", fields["digest"])
		return
	# Pieces that fit a socket's buffer several times: more than one may be on its way.
	var piece = Codec.piece(data, offset, min(256 << 10, data.size() - offset))
	_send("ASSET_DATA", {"digest": fields["digest"], "offset": offset, "size": data.size()}, [piece])


func _on_reset(fields):
	episode = fields["episode"]
	seed_episode = fields["seed_episode"]
	_t0 = fields["t0_ns"]
	_answers = {}
	_grants = []
	_scene.arrived = []
	_meshes.reset(_was_here_before())
	_said = {}
	_stepped = false
	_newest = -1
	_fault = ""
	reset(fields["seed"], _t0 / 1e9)
	if _fault != "":
		_socket.send(_fault_frame(-1, "reset", ""))
		return
	_heart.phase = "step"
	_state = ACTIVE
	_send("RESET_DONE", _mine({"episode": episode}))


# Whether the broker may know meshes that an earlier process of this world announced.
func _was_here_before():
	return _epoch > 1 or _attempt > 1


# --- frames -------------------------------------------------------------------------------------------------


func _answer():
	var grant = _grants[0][0]
	var number = grant["frame"]
	if not _answers.has(number):
		if number < _newest:
			_grants.pop_front()
			_error("unexpected", "frame %d comes after frame %d" % [number, _newest], "GRANT")
			return
		var answer = _answered(grant, _grants[0][1])
		if answer == null:
			return  # the world has not finished: the grant stays in front
		_answers[number] = answer
		_newest = number
	_grants.pop_front()
	_socket.send(_answers[number])


func _answered(grant, parts):
	frame = grant["frame"]
	_fault = ""
	var culprit = _decode(grant, parts)
	if culprit != "":
		return _fault_frame(frame, "decode", culprit)
	var commands = []
	for action in products.get("action", []):
		commands += action["commands"]
	var now = grant["t_ns"] - _t0
	var objects = step(now / 1e9, (_previous if _stepped else now) / 1e9, commands)
	if typeof(objects) == TYPE_STRING and objects == WAIT:
		return null
	if typeof(objects) != TYPE_ARRAY:
		fail("step returned %s and no list of objects; an error of the script is above" % str(objects))
	if _fault != "":
		return _fault_frame(frame, "step", "")
	var meshes = []
	for item in objects:
		item["mesh"] = _looked(item["mesh"])
		meshes.append(item["mesh"])
	var product = _scene.build(objects)
	if product == null:
		fail(_scene.problem)
		return _fault_frame(frame, "encode", "")
	_previous = now
	_stepped = true
	var entry = {"topic": "scene", "digest": product["digest"]}
	var done = _mine({"episode": episode, "frame": frame, "products": [entry]})
	var change = _meshes.change(frame, meshes)
	if change != null:
		done["geometry"] = change
	return _frame("DONE", done, [product["header"], product["body"]])


# A mesh as the run may have it.
func _looked(mesh):
	if typeof(mesh) != TYPE_STRING or not RunTimeMeshes.is_name(mesh):
		return mesh
	if _meshes.max_faces == 0:
		return ""  # the run takes no meshes now
	if not _meshes.has(mesh):
		_say("%s is not there; objects with it are boxes until offer_mesh brings it" % mesh)
	return mesh


# The source of a product that cannot be read, or empty.
func _decode(grant, parts):
	products = {}
	var at = 1
	for input in grant["inputs"]:
		if input["status"] == "absent":
			continue
		var decoded = _codec.decode_payload(input["topic"], parts[at], parts[at + 1])
		var why = _codec.message
		if decoded != null and input["digest"] != "" and parts[at].size() + parts[at + 1].size() <= DIGESTED_BYTES:
			if Codec.product_digest(parts[at], parts[at + 1]) != input["digest"]:
				decoded = null
				why = "the bytes do not have the digest of their DONE"
		if decoded == null:
			fail("%s of %s in frame %d: %s" % [input["topic"], input["source"], frame, why])
			return input["source"]
		if not products.has(input["topic"]):
			products[input["topic"]] = []
		products[input["topic"]].append(decoded)
		at += 2
	return ""


func _fault_frame(number, phase, culprit):
	_faulted = true
	printerr("%s: %s: %s" % [name, phase, _fault])
	var fields = {"episode": episode, "frame": number, "phase": phase, "message": _fault, "culprit": culprit}
	return _frame("FAULT", _mine(fields))


# --- state that outlives the process ------------------------------------------------------------------------


func _saved():
	var head = _codec.pack({
		"mark": STATE_MARK, "arrived": _scene.arrived, "previous": _previous, "stepped": _stepped, "newest": _newest
	})
	return Codec.join_frame([head, save()])


func _on_restore(state):
	var parts = _codec.split_frame(state)
	var head = _codec.unpack(parts[0]) if parts != null and parts.size() == 2 else null
	_fault = ""
	if typeof(head) != TYPE_DICTIONARY or str(head.get("mark")) != STATE_MARK:
		fail("this is no state of a world of this library")
	else:
		_scene.arrived = head["arrived"]
		_previous = head["previous"]
		_stepped = head["stepped"]
		_newest = head["newest"]
		_meshes.reset(_was_here_before(), _newest + 1)
		restore(parts[1])
	if _fault != "":
		_socket.send(_fault_frame(-1, "restore", ""))
	else:
		_send("READY", _mine({}))
