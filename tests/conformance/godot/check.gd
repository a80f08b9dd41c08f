extends SceneTree
# What the tests ask of the add-on: godot3-server -s check.gd KIND FILE ANSWERS
#
# Each line of the file is a case, its fields divided by tabs, and each line of the answers is the answer
# to it.

const Axes = preload("res://addons/caviar/caviar_axes.gd")
const Codec = preload("res://addons/caviar/caviar_codec.gd")
const Products = preload("res://addons/caviar/caviar_products.gd")
const RunTimeMeshes = preload("res://addons/caviar/caviar_run_time_meshes.gd")
const Scene = preload("res://addons/caviar/caviar_scene.gd")
const Scenery = preload("res://addons/caviar/caviar_scenery.gd")
const World = preload("res://addons/caviar/caviar_world.gd")

var codec = Codec.new()
var builder


func _init():
	var arguments = OS.get_cmdline_args()
	var count = arguments.size()
	var cases = File.new()
	var answers = File.new()
	cases.open(arguments[count - 2], File.READ)
	answers.open(arguments[count - 1], File.WRITE)
	for line in cases.get_as_text().split("\n", false):
		answers.store_line(call("ask_" + arguments[count - 3], line.split("\t")))
	answers.close()
	quit(0)


func ask_vectors(fields):
	var header = bytes(fields[2])
	if fields[0] == "arrays":
		return "ok" if codec.decode_arrays(header, bytes(fields[3])) != null else codec.code
	if fields[0] == "payload":
		var value = codec.decode_payload(fields[1], header, bytes(fields[3]))
		if value == null:
			return codec.code
		var product = codec.encode_payload(fields[1], value)
		return join(["ok", product["header"].hex_encode(), product["body"].hex_encode(), product["digest"]])
	var message = codec.decode_message(header)
	if message == null:
		return codec.code
	var parts = [header]
	for part in fields[4].split(",", false):
		parts.append(zeros(part.substr(1, 20).to_int()) if part[0] == "#" else bytes(part))
	if not codec.check_parts(message, parts):
		return codec.code
	var frame = Codec.join_frame(parts)
	if codec.split_frame(frame) != parts:
		return "other parts in a frame"
	return join(["ok", codec.encode_message(message["type"], message).hex_encode(), frame.hex_encode()])


func ask_arrays(fields):
	var found = []
	for array in codec.decode_arrays(bytes(fields[0]), bytes(fields[1])):
		var integers = PoolStringArray()
		if array.dtype[1] == "i" or array.dtype[1] == "u":
			for element in array.to_ints():
				integers.append(str(element))
		found.append(text(array.to_floats()) + ";" + integers.join(" "))
	return join(found)


func ask_axes(fields):
	var axes = Axes.new(fields[0])
	var pose = axes.pose_from_enu(numbers(fields[1]), numbers(fields[2]))
	var motion = axes.motion_from_enu(numbers(fields[3]), numbers(fields[4]))
	var pose_back = axes.pose_to_enu(pose["position"], pose["orientation"])
	var motion_back = axes.motion_to_enu(motion["velocity"], motion["angular_velocity"])
	var found = []
	for pair in [[pose, motion], [pose_back, motion_back]]:
		found += [text(pair[0]["position"]), text(pair[0]["orientation"])]
		found += [text(pair[1]["velocity"]), text(pair[1]["angular_velocity"])]
	return join(found)


func ask_engine_mesh(fields):
	var found = Axes.new(fields[0]).mesh_to_enu(rows(fields[1]), rows(fields[2]))
	return join([text(flat(found["vertices"])), text(flat(found["triangles"]))])


# The vertices of a mesh, offered before and, where MAX_FACES is given, while a run goes on: what offer_mesh returns.
func ask_offered(fields):
	var world = World.new()
	world._meshes.max_faces = int(fields[0])
	world._state = World.READY if fields[0] != "" else World.PREPARING
	var found = world.offer_mesh("car", rows(fields[1]), [[0, 1, 2]])
	return join([found["mesh"].substr(0, 11), text(found["dimensions"]), text(found["centre"])])


# x, y, z and the quaternion of a node that is scaled by 2: its pose in ENU.
func ask_transform(fields):
	var p = numbers(fields[0])
	var basis = Basis(Quat(p[3], p[4], p[5], p[6])).scaled(Vector3(2, 2, 2))
	var transform = Transform(basis, Vector3(p[0], p[1], p[2]))
	var pose = Axes.new("godot").transform_to_enu(transform)
	return join([text(pose["position"]), text(pose["orientation"])])


func ask_mounts(fields):
	if fields[0] == "welcome":
		builder = Scene.new(codec, codec.decode_message(bytes(fields[1]))["scenario"]["devices"])
		return ""
	var objects = []
	for field in fields:
		var words = field.split("|")
		var item = Scene.object(words[0], words[1], numbers(words[2]), numbers(words[5]))
		item["orientation"] = numbers(words[3])
		item["velocity"] = numbers(words[4])
		if words.size() > 6:
			item[words[6]] = words[2]
		objects.append(item)
	var product = builder.build(objects)
	if product == null:
		return builder.problem
	return join([product["header"].hex_encode(), product["body"].hex_encode()])


func ask_match(fields):
	return str(Scene.matches(fields[0], fields[1]))


func ask_mesh(fields):
	var scenery = Scenery.new()
	if fields[0] == "material":
		scenery.offer_scenery([], [{"name": fields[1], "type": fields[2], "thickness": float(fields[3])}])
	else:
		scenery.offer_mesh(fields[1], [[0, 0, 0], [0, 0, 0], [0, 0, 0]], [numbers(fields[2])])
	return "ok" if scenery.problem == "" else scenery.problem


# Steps `limit N`, `reset AGAIN FRAME`, `add HEX`, `refuse MESH`, `frame NUMBER MESH,MESH`, where a MESH is the number
# of one that was added: the names of `add`, what DONE says of `frame`.
func ask_spawned(fields):
	var meshes = RunTimeMeshes.new()
	var names = []
	var answers = []
	for field in fields:
		var words = field.split(" ")
		if words[0] == "limit":
			meshes.max_faces = int(words[1])
		elif words[0] == "reset":
			meshes.reset(words[1] == "1", int(words[2]))
		elif words[0] == "add":
			names.append(meshes.add(bytes(words[1])))
			answers.append(names.back())
		elif words[0] == "refuse":
			meshes.refuse(names[int(words[1])].substr(8, 64))
		elif words[0] == "frame":
			var used = []
			for word in words[2].split(",", false):
				used.append(names[int(word)])
			var change = meshes.change(int(words[1]), used)
			var announced = []
			if change != null:
				for asset in change["assets"]:
					announced.append(asset["name"])
			var told = PoolStringArray(announced).join(",")
			answers.append("-" if change == null else "%d:%s" % [change["frame"], told])
	return join(answers)


# A mesh that comes while a run goes on, MAX_FACES, vertices, triangles: why it would be refused.
func ask_spawn(fields):
	var wrong = Scenery.wrong_at_run_time(fields[0], rows(fields[2]), rows(fields[3]), int(fields[1]))
	return "ok" if wrong == "" else wrong


func flat(rows):
	var found = []
	for row in rows:
		found += row
	return found


func rows(text):
	var found = []
	var all = numbers(text) if text != "" else []
	for i in range(all.size() / 3):
		found.append([all[3 * i], all[3 * i + 1], all[3 * i + 2]])
	return found


func ask_users(fields):
	var found = []
	for user in Products.users(codec.decode_payload("link", bytes(fields[0]), bytes(fields[1]))):
		var values = [user["abs_y"], user["snr"], user["tx_beam"], user["rx_beam"]]
		found.append("%s %s %s %s" % [user["tx"], user["rx"], user["carrier"], text(values)])
	return join(found)


func ask_paths(fields):
	var found = []
	for path in Products.paths(codec.decode_payload("channel", bytes(fields[0]), bytes(fields[1]))):
		var values = [path["tau"]] + path["aod"] + path["real"] + path["imaginary"] + path["doppler"]
		values += path["interactions"]
		for point in path["points"]:
			values += point
		found.append("%s %s %s" % [path["tx"], path["rx"], text(values)])
	return join(found)


func ask_commands(fields):
	var found = []
	for command in codec.decode_payload("action", bytes(fields[0]), bytes(fields[1]))["commands"]:
		var values = [command.get("tx_beam", 0), command.get("speed", 0)]
		values += command.get("position", command.get("velocity", []))
		found.append("%s %s %s" % [command["type"], command.get("object", command.get("tx")), text(values)])
	return join(found)


static func join(words):
	return PoolStringArray(words).join("\t")


# Numbers as `x` and the digits of their bytes: str has six digits.
static func text(values):
	var words = PoolStringArray()
	for value in values:
		var buffer = StreamPeerBuffer.new()
		buffer.big_endian = true
		buffer.put_double(value)
		words.append("x" + buffer.data_array.hex_encode())
	return words.join(" ")


static func numbers(words):
	var found = []
	for word in words.split(" "):
		if word[0] != "x":
			found.append(float(word))
			continue
		var buffer = StreamPeerBuffer.new()
		buffer.big_endian = true
		buffer.data_array = bytes(word.substr(1, 16))
		found.append(buffer.get_double())
	return found


static func bytes(digits):
	var found = PoolByteArray()
	for i in range(0, digits.length(), 2):
		found.append(("0x" + digits.substr(i, 2)).hex_to_int())
	return found


static func zeros(count):
	var found = PoolByteArray()
	found.resize(count)
	for i in range(0 if count > 64 else count):
		found[i] = 0
	return found
