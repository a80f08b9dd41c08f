# Files that a world brings, made in memory: meshes as PLY, the static scenery as XML.
#
# What is wrong is said by `problem`, which stays until `clear`.

const Codec = preload("caviar_codec.gd")
const MATERIALS = [
	"asphalt_concrete", "brick", "carpet_tile", "ceiling_board", "chipboard", "clear_acrylic", "concrete",
	"floorboard", "glass", "marble", "metal", "plasterboard", "plywood", "vinyl_tile", "wood", "very_dry_ground",
	"medium_dry_ground", "wet_ground", "vacuum",
]

var problem = ""
var _files = {}
var _digests = {}


func clear():
	problem = ""
	_files = {}
	_digests = {}


func has(name):
	return _files.has(name)


func _wrong(why):
	if problem == "":
		problem = why
	return ""


# The name of the asset, empty where it is none.
func offer(name, data):
	if not Codec.is_path(name):
		return _wrong("'%s' is no name of an asset; write a relative path such as objects/car.ply" % name)
	_files[name] = data
	_digests[name] = Codec.sha256([data])
	return name


# A mesh of objects: vertices in body axes and any unit are fitted into the unit box. material: of ITU-R P.2040;
# empty: what the channel's settings say.
func offer_mesh(name, vertices, triangles, material = ""):
	return offer("objects/%s.ply" % name, unit_mesh(name, vertices, triangles, material))


# The file of a mesh that fills the unit box; `problem` says what is wrong with it.
func unit_mesh(name, vertices, triangles, material):
	if material != "" and not material in MATERIALS:
		_wrong("mesh '%s': no type is '%s'; one of %s" % [name, material, str(MATERIALS)])
	return _ply(name, _in_unit_box(vertices), triangles, material)


# What a run would refuse of a mesh that comes while it goes on, or empty.
static func wrong_at_run_time(name, vertices, triangles, max_faces):
	var who = "mesh '%s': " % name
	if triangles.size() == 0:
		return who + "it has no triangle"
	if max_faces > 0 and triangles.size() > max_faces:
		return who + "it has %d triangles, and this run takes %d" % [triangles.size(), max_faces]
	for vertex in vertices:
		if not _is_finite(vertex):
			return who + "a vertex is not finite"
	for side in box_of(vertices)["dimensions"]:
		if not side > 0:
			return who + "it is flat"
	return ""


static func _is_finite(vertex):
	return abs(vertex[0]) < INF and abs(vertex[1]) < INF and abs(vertex[2]) < INF  # no NaN is


# {dimensions, centre} of the box around the vertices that are finite.
static func box_of(vertices):
	var box = {"dimensions": [], "centre": []}
	for i in range(3):
		var low = INF
		var high = -INF
		for vertex in vertices:
			if _is_finite(vertex):  # min and max of Godot 3 have single precision
				low = vertex[i] if vertex[i] < low else low
				high = vertex[i] if vertex[i] > high else high
		box["dimensions"].append(high - low + 0.0 if high >= low else 0.0)
		box["centre"].append((high + low) / 2.0 if high >= low else 0.0)
	return box


# meshes: [{name, vertices, triangles, material}]; materials: [{name, type, thickness}], thickness 0.2 m if
# left out.
func offer_scenery(meshes, materials, name = "world"):
	var xml = "<scene version=\"2.1.0\">\n"
	var known = {}
	for material in materials:
		var thickness = material.get("thickness", 0.2) + 0.0
		if not material["type"] in MATERIALS:
			var why = "material '%s': no type is '%s'; one of %s"
			_wrong(why % [material["name"], material["type"], str(MATERIALS)])
		if not thickness > 0:
			_wrong("material '%s': a thickness of %s m; it has to be above 0" % [material["name"], str(thickness)])
		if known.has(material["name"]):
			_wrong("material '%s' is there twice" % material["name"])
		known[material["name"]] = true
		xml += "  <bsdf type=\"itu-radio-material\" id=\"mat-%s\">\n" % _escaped(material["name"])
		xml += "    <string name=\"type\" value=\"%s\"/>\n" % material["type"]
		xml += "    <float name=\"thickness\" value=\"%s\"/>\n  </bsdf>\n" % str(thickness)
	for mesh in meshes:
		if not known.has(mesh["material"]):
			_wrong("mesh '%s': no material is called '%s'" % [mesh["name"], mesh["material"]])
		var file = "scenery/meshes/%s.ply" % mesh["name"]
		if has(file):
			_wrong("mesh '%s' is there twice" % mesh["name"])
		offer(file, _ply(mesh["name"], mesh["vertices"], mesh["triangles"]))
		xml += "  <shape type=\"ply\" id=\"mesh-%s\">\n" % _escaped(mesh["name"])
		xml += "    <string name=\"filename\" value=\"meshes/%s.ply\"/>\n" % _escaped(mesh["name"])
		xml += "    <boolean name=\"face_normals\" value=\"true\"/>\n"
		xml += "    <ref id=\"mat-%s\" name=\"bsdf\"/>\n  </shape>\n" % _escaped(mesh["material"])
	return offer("scenery/%s.xml" % name, Codec.utf8(xml + "</scene>\n"))


static func _escaped(text):
	return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace("\"", "&quot;")


func _ply(name, vertices, triangles, material = ""):
	var data = StreamPeerBuffer.new()
	data.put_data(Codec.utf8(
		"ply\nformat binary_little_endian 1.0\n"
		+ ("comment material %s\n" % material if material != "" else "")
		+ "element vertex %d\n" % vertices.size()
		+ "property float x\nproperty float y\nproperty float z\nelement face %d\n" % triangles.size()
		+ "property list uchar int vertex_indices\nend_header\n"
	))
	for vertex in vertices:
		for i in range(3):
			data.put_float(float(vertex[i]) + 0.0)
	for triangle in triangles:
		data.put_u8(3)
		for i in range(3):
			if triangle.size() != 3 or triangle[i] < 0 or triangle[i] >= vertices.size():
				var why = "mesh '%s': the corners %s are not three of its %d vertices"
				_wrong(why % [name, str(triangle), vertices.size()])
				return data.data_array
			data.put_32(int(triangle[i]))
	return data.data_array


static func _in_unit_box(vertices):
	var box = box_of(vertices)
	var found = []
	for vertex in vertices:
		var row = []
		for i in range(3):
			var side = box["dimensions"][i]
			row.append((vertex[i] - box["centre"][i]) / side if side > 0 else 0.0)
		found.append(row)
	return found


func _names():
	var names = _files.keys()
	names.sort()
	return names


# Entries of ASSET_OFFER.
func entries():
	var found = []
	for name in _names():
		found.append({"name": name, "digest": _digests[name], "size": _files[name].size()})
	return found


# The geometry digest of READY; empty without files.
func geometry():
	if _files.size() == 0:
		return ""
	var zero = StreamPeerBuffer.new()
	zero.put_u8(0)
	var pieces = []
	for name in _names():
		pieces += [Codec.utf8(name), zero.data_array, Codec.utf8(_digests[name]), zero.data_array]
	return Codec.sha256(pieces)


# The file of a digest, or null.
func find(digest):
	for name in _files:
		if _digests[name] == digest:
			return _files[name]
	return null
