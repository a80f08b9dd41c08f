# Meshes that come while an episode goes on, each for as long as an object has it: SPEC.md, Geometry at run time.

const Codec = preload("caviar_codec.gd")
const LINGER_FRAMES = 20  # for which one stays that no object has any more

var max_faces = 0  # triangles that a mesh may have; 0: the run takes none, and objects are boxes
var _files = {}
var _used = {}  # frame in which an object had it last, or in which it came
var _refused = {}
var _announced = "[]"  # the names, as a text; empty: not known
var _frame = 0  # that is computed next


# Begin an episode, or go on in it at a frame. again: another process of the world may have announced some.
func reset(again, frame = 0):
	_files = {}
	_used = {}
	_announced = "" if again else "[]"
	_frame = frame


# Whether a name is that of a mesh that came while a run went on: consumers without that mesh have a box.
static func is_name(name):
	if name.length() != 76 or not name.begins_with("objects/") or not name.ends_with(".ply"):
		return false
	for letter in name.substr(8, 64):
		if not letter in "0123456789abcdef":
			return false
	return true


# Bring a mesh; its name.
func add(data):
	var name = "objects/%s.ply" % Codec.sha256([data])
	_files[name] = data
	_used[name] = max(_used.get(name, 0), _frame)
	return name


func has(name):
	return _files.has(name) and not _refused.has(name)


# What DONE says of the meshes of a frame; null where they are those of the frame before.
func change(frame, meshes):
	_frame = frame + 1
	if max_faces == 0:
		return null
	for name in meshes:
		if _used.has(name):
			_used[name] = frame
	var names = []
	for name in _used.keys():
		if _used[name] + LINGER_FRAMES < frame:
			_used.erase(name)
			_files.erase(name)
		elif has(name):
			names.append(name)
	names.sort()
	if str(names) == _announced:
		return null
	_announced = str(names)
	var assets = []
	for name in names:
		assets.append({"name": name, "digest": name.substr(8, 64), "size": _files[name].size()})
	return {"frame": frame, "assets": assets}


# The broker takes a mesh for none, or, where the digest is empty, all of them.
func refuse(digest):
	for name in _files:
		if digest == "" or name.substr(8, 64) == digest:
			_refused[name] = true


# The file of a digest, or null.
func find(digest):
	return _files.get("objects/%s.ply" % digest)
