# The product of a frame from its objects, with the scenario's devices mounted on them.
#
# An object is a dictionary, as `object` makes it. `problem` says what was wrong with one in the last `build`.

const Axes = preload("caviar_axes.gd")
const Codec = preload("caviar_codec.gd")
const RunTimeMeshes = preload("caviar_run_time_meshes.gd")
const LIGHT_M_S = 299792458.0
# Of an object; `centre` comes with what `offer_mesh` returns.
const FIELDS = [
	"name", "class", "position", "dimensions", "mesh", "orientation", "velocity", "angular_velocity", "centre"
]

var prefixes = []  # that names have to begin with; empty: any will do
var scenery = null  # what was offered; null: meshes are not looked at
var arrived = []  # objects of the last frame, those that came first in front
var problem = ""
var _specs
var _codec


# devices: as in `scenario.devices` of WELCOME.
func _init(codec, devices):
	_codec = codec
	_specs = devices


# position: middle of the box [m]; dimensions: length, width, height [m]. Set the other fields as needed.
static func object(name, kind, position, dimensions):
	return {
		"name": name, "class": kind, "position": position, "dimensions": dimensions, "mesh": "",
		"orientation": [1.0, 0.0, 0.0, 0.0], "velocity": [0.0, 0.0, 0.0], "angular_velocity": null,
	}


func fixed_names():
	var found = []
	for spec in _specs:
		if spec["on"] == "":
			found.append(spec["name"])
	return found


# {header, body, digest} of the scene, or null with a problem.
func build(objects):
	problem = ""
	var there = {}
	for item in objects:
		_check(item)
		if there.has(item["name"]):
			_wrong("object '%s' is in the frame twice; give each a name of its own" % item["name"])
		there[item["name"]] = item
	if problem != "":
		return null
	var names = there.keys()
	names.sort()
	var scene = {"names": names, "classes": [], "assets": [], "devices": _devices(objects, there)}
	var turning = false
	for name in names:
		scene["classes"].append(there[name]["class"])
		scene["assets"].append(there[name]["mesh"])
		turning = turning or there[name]["angular_velocity"] != null
	for field in [["position", 3], ["orientation", 4], ["velocity", 3], ["dimensions", 3]]:
		scene[field[0]] = _rows(field[0], field[1], names, there)
	if turning:
		scene["angular_velocity"] = _rows("angular_velocity", 3, names, there)
	var product = _codec.encode_payload("scene", scene)
	if product == null:
		problem = _codec.message
	return product


static func _rows(field, columns, names, there):
	var values = []
	for name in names:
		values.append([0.0, 0.0, 0.0] if there[name][field] == null else there[name][field])
	return Codec.rows(columns, values)


func _wrong(why):
	if problem == "":
		problem = why


func _check(item):
	var name = item["name"]
	if typeof(name) != TYPE_STRING or name == "" or not Codec.is_printable(name):
		_wrong("an object is called '%s'; a name has printable characters" % str(name))
		return
	var who = "object '%s': " % name
	var begins = prefixes.size() == 0
	for prefix in prefixes:
		begins = begins or name.begins_with(prefix)
	if not begins:
		_wrong(who + "no prefix of READY begins its name (%s); add one in prepare" % str(prefixes))
	for field in item:
		if not field in FIELDS:
			_wrong(who + "has a field '%s'; its fields are %s" % [field, PoolStringArray(FIELDS).join(", ")])
	_check_numbers(who + "position", item["position"], 3, 1e9)
	_check_numbers(who + "orientation", item["orientation"], 4, 2.0)
	_check_numbers(who + "velocity", item["velocity"], 3, LIGHT_M_S)
	_check_numbers(who + "dimensions", item["dimensions"], 3, 1e5)
	if item["angular_velocity"] != null:
		_check_numbers(who + "angular_velocity", item["angular_velocity"], 3, 1e9)
	if problem != "":
		return
	var q = item["orientation"]
	var norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
	if abs(norm - 1.0) > 0.001:
		_wrong(who + "the quaternion has the norm %s; normalise it" % str(norm))
	for side in item["dimensions"]:
		if side <= 0:
			_wrong(who + "dimensions are %s; each has to be above 0 m" % str(item["dimensions"]))
	var mesh = item["mesh"]
	if typeof(mesh) != TYPE_STRING:
		_wrong(who + "mesh is %s; give it the text that offer_mesh returns as mesh" % str(mesh))
	elif mesh != "" and scenery != null and not scenery.has(mesh) and not RunTimeMeshes.is_name(mesh):
		_wrong(who + "mesh is '%s', which was not offered; take it from what offer_mesh returns" % mesh)


func _check_numbers(what, values, count, most):
	var right = typeof(values) == TYPE_ARRAY and values.size() == count
	if right:
		for value in values:
			right = right and abs(value) <= most  # which no NaN is
	if not right:
		_wrong("%s is %s; it needs %d numbers within ±%s" % [what, str(values), count, str(most)])


# --- devices ------------------------------------------------------------------------------------------------


func _devices(objects, there):
	var still = []
	for name in arrived:
		if there.has(name):
			still.append(name)
	for item in objects:
		if not item["name"] in arrived:
			still.append(item["name"])
	arrived = still
	var found = {}
	for spec in _specs:
		if spec["on"] == "":
			found[spec["name"]] = _device(spec, null)
			continue
		var count = 0
		for name in arrived:
			if count < spec["count"] and matches(spec["on"], name):
				found["%s/%s" % [name, spec["name"]]] = _device(spec, there[name])
				count += 1
	var names = found.keys()
	names.sort()
	var devices = []
	for name in names:
		devices.append(found[name])
	return devices


static func _radians(degrees):
	return degrees * (PI / 180.0)


static func _device(spec, parent):
	var yaw = _radians(spec["yaw_deg"])
	var turned = Axes.from_euler(yaw, _radians(spec["pitch_deg"]), _radians(spec["roll_deg"]))
	var position = spec["position_m"].duplicate()
	var made = {"type": spec["kind"], "name": spec["name"]}
	if parent != null:
		made["name"] = "%s/%s" % [parent["name"], spec["name"]]
		made["parent"] = parent["name"]
		position[2] += {"centre": 0.0, "roof": 0.5, "floor": -0.5}[spec["mount"]] * parent["dimensions"][2]
		if spec.get("keeps_heading", false):
			turned = Axes.multiply(Axes.inverse(parent["orientation"]), turned)
	made["position"] = position
	made["orientation"] = turned
	if spec["kind"] == "antenna":
		made["role"] = spec["role"]
		made["power_dbm"] = spec["power_dbm"]
		made["carriers"] = spec.get("carriers", [])
		made["array"] = _array(spec["array"])
	elif spec["kind"] == "lidar":
		made["beams"] = spec["beams"]
		made["azimuth_steps"] = spec["azimuth_steps"]
		made["elevation_min"] = _radians(spec["elevation_deg"][0])
		made["elevation_max"] = _radians(spec["elevation_deg"][1])
		made["min_range"] = spec["range_m"][0]
		made["max_range"] = spec["range_m"][1]
	else:
		made["width"] = spec["size_px"][0]
		made["height"] = spec["size_px"][1]
		made["field_of_view"] = _radians(spec["field_of_view_deg"])
	return made


static func _array(given):
	if given == null:
		return {}
	var array = given.duplicate()
	# A path on the broker's machine here, the name of an asset in a scene.
	if given.get("pattern_file", "") != "":
		var segments = given["pattern_file"].split("/")
		array["pattern_file"] = "patterns/" + segments[segments.size() - 1]
	return array


# Whether a name matches `on` of a device: the name itself, or a pattern with * ? [abc] [!abc].
static func matches(pattern, name):
	return pattern == name or _matches(pattern, 0, name, 0)


static func _matches(pattern, p, name, n):
	while p < pattern.length():
		if pattern[p] == "*":
			for from in range(n, name.length() + 1):
				if _matches(pattern, p + 1, name, from):
					return true
			return false
		if n >= name.length():
			return false
		var close = -1
		if pattern[p] == "[":
			# A closing bracket right behind the opening one, or its !, is one of the characters.
			close = pattern.find("]", p + (3 if pattern.substr(p + 1, 1) == "!" else 2))
		if close >= 0:
			if not _in_set(pattern.substr(p + 1, close - p - 1), name[n]):
				return false
			p = close
		elif pattern[p] != "?" and pattern[p] != name[n]:
			return false
		p += 1
		n += 1
	return n == name.length()


static func _in_set(members, character):
	var inverted = members[0] == "!"
	var found = false
	var i = 1 if inverted else 0
	while i < members.length():
		if i + 2 < members.length() and members[i + 1] == "-":
			found = found or (members[i] <= character and character <= members[i + 2])
			i += 3
		else:
			found = found or members[i] == character
			i += 1
	return found != inverted
