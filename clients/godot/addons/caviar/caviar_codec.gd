extends "caviar_messagepack.gd"
# Messages and products to bytes and back: fields checked against the schema, arrays in a body.
#
# What is refused returns null (or false), and `code` and `message` say why.

const Bytes = preload("caviar_messagepack.gd")  # Godot 3 finds inherited names in no static function
const Schema = preload("caviar_schema.gd")

const MAX_HEADER = 1 << 20
const MAX_PARTS = 513
const MAX_ASSET_CHUNK = 4 << 20
const WIDTHS = {
	"|b1": 1, "|u1": 1, "|i1": 1, "<u2": 2, "<i4": 4, "<i8": 8, "<u8": 8,
	"<f4": 4, "<f8": 8, "<c8": 8, "<c16": 16,
}

var schema = Schema.new()
var _body  # bytes that references point into
var _end = 0  # of the last array that was read
var _placed  # buffer of the arrays that were written


# An array of a product: element type, shape, and little-endian bytes in C order.
class NdArray:
	var dtype = ""
	var shape = []
	var data

	func _buffer():
		var buffer = StreamPeerBuffer.new()
		buffer.data_array = data
		return buffer

	# Elements as floats; of complex ones real and imaginary parts in turn.
	func to_floats():
		var buffer = _buffer()
		var found = []
		if dtype == "<f8" or dtype == "<c16":
			for _i in range(data.size() / 8):
				found.append(buffer.get_double())
		elif dtype == "<f4" or dtype == "<c8":
			for _i in range(data.size() / 4):
				found.append(buffer.get_float())
		else:
			for element in to_ints():
				# An int has 64 bits with a sign: the upper half of uint64 is negative there. `float(int)` has single
				# precision in Godot 3, a sum with a float has double.
				found.append(element + (pow(2.0, 64) if dtype == "<u8" and element < 0 else 0.0))
		return found

	# Elements of an array of integers or booleans; of uint64 the same 64 bits.
	func to_ints():
		var buffer = _buffer()
		var found = []
		for _i in range(data.size() / WIDTHS[dtype]):
			if dtype == "|i1":
				found.append(buffer.get_8())
			elif dtype == "<u2":
				found.append(buffer.get_u16())
			elif dtype == "<i4":
				found.append(buffer.get_32())
			elif dtype == "<i8" or dtype == "<u8":
				found.append(buffer.get_64())
			else:
				found.append(buffer.get_u8())
		return found


# Rows of floats as an array of float64; zeros are positive.
static func rows(columns, values):
	var buffer = StreamPeerBuffer.new()
	for row in values:
		for i in range(columns):
			buffer.put_double(row[i] + 0.0)
	var made = NdArray.new()
	made.dtype = "<f8"
	made.shape = [values.size(), columns]
	made.data = buffer.data_array
	return made


# --- reading structs: types are checked, defaults filled in, arrays taken from the body ---------------------


func _read_struct(struct, value, place):
	if typeof(value) != TYPE_DICTIONARY:
		return _malformed("%s is no map" % place)
	var found = {}
	var sizes = {}
	if struct.tag != "":
		found["type"] = struct.tag
	for field in struct.fields:
		if value.has(field.name):
			found[field.name] = _read_field(field.type, value[field.name], "%s.%s" % [place, field.name], sizes)
		elif field.required:
			_malformed("%s.%s is missing" % [place, field.name])
		elif field.type.kind == "S" and not field.left_out:
			found[field.name] = _read_struct(schema.structs[field.type.words[0]], {}, place)
		elif not field.left_out:
			found[field.name] = field.standard
		if code != "":
			return null
	for size in struct.sizes:
		for list in struct.sizes[size]:
			_agree(sizes, size, found[list].size(), "%s.%s" % [place, list])
	if code == "" and struct.name == "Channel":
		_check_offsets(found, place)
	return found if code == "" else null


func _agree(sizes, name, count, place):
	# A size is a number, or a name that stands for one throughout the struct.
	var known = name.to_int() if "0123456789".find(name[0]) >= 0 else sizes.get(name, count)
	if known != count:
		_malformed("%s has %d where %s is %d" % [place, count, name, known])
	sizes[name] = count


func _check_offsets(channel, place):
	var offsets = channel.offsets.to_ints()
	var pairs = channel.tx.size() * channel.rx.size()
	var right = offsets.size() == pairs + 1 and offsets[0] == 0 and offsets[pairs] == channel.tau.shape[0]
	for i in range(pairs):
		right = right and offsets[i] <= offsets[i + 1]
	if not right:
		_malformed("%s.offsets do not count the paths of %d pairs" % [place, pairs])


func _read_field(type, value, place, sizes):
	var kind = typeof(value)
	var right = false
	if type.kind == "*":
		return value
	if type.kind == "b":
		right = kind == TYPE_BOOL
	elif type.kind == "i":
		right = kind == TYPE_INT and _in_bounds(type, value)
	elif type.kind == "f":
		if kind == TYPE_INT:
			value += 0.0
		right = (kind == TYPE_INT or kind == FLOAT) and _in_bounds(type, value)
	elif type.kind == "e":
		right = kind == TYPE_STRING and value in type.words
	elif type.kind == "l" or type.kind == "t":
		if kind == TYPE_ARRAY and value.size() >= type.fewest and value.size() <= type.most:
			var list = []
			for i in range(value.size()):
				list.append(_read_field(type.inner, value[i], "%s[%d]" % [place, i], sizes))
				if code != "":
					return null
			return list
	elif type.kind == "m":
		if kind == TYPE_DICTIONARY:
			var map = {}
			for key in value:
				map[key] = _read_field(type.inner, value[key], "%s.%s" % [place, key], sizes)
			return map
	elif type.kind == "S":
		var name = _member(type, value)
		if name != "":
			return _read_struct(schema.structs[name], value, place)
	elif type.kind == "a":
		return _read_array(type, value, place, sizes)
	else:
		right = kind == TYPE_STRING and _is_text(type, value)
	if right:
		return value
	return _malformed("%s is not what its field holds: %s" % [place, str(value).substr(0, 80)])


# The struct that a value is: the only one, or that of its tag; empty where it is none.
func _member(type, value):
	if type.words.size() == 1:
		return type.words[0]
	for name in type.words:
		if typeof(value) == TYPE_DICTIONARY and typeof(value.get("type")) == TYPE_STRING:
			if schema.structs[name].tag == value["type"]:
				return name
	return ""


func _in_bounds(type, value):
	if typeof(value) == FLOAT and (is_nan(value) or is_inf(value)):
		return false
	if type.low != null and (value < type.low or type.above and value == type.low):
		return false
	return type.high == null or value <= type.high


func _is_text(type, text):
	if type.kind == "d" or type.kind == "D":
		if text == "" and type.kind == "D":
			return true
		for character in text:
			if "0123456789abcdef".find(character) < 0:
				return false
		return text.length() == 64
	if type.kind == "n":
		return text.length() >= 1 and text.length() <= 128 and is_printable(text)
	if type.kind == "p":
		return is_path(text)
	return text.length() >= type.fewest and text.length() <= type.most


static func is_printable(text):
	for byte in Bytes.utf8(text):
		if byte < 32 or byte == 127:
			return false
	return true


# Whether a text is the name of an asset: a relative path that stays below its folder.
static func is_path(text):
	if text.length() > 255 or not is_printable(text) or text.find("\\") >= 0:
		return false
	for segment in text.split("/"):
		if segment == "" or segment == "." or segment == "..":
			return false
	return true


func _read_array(type, value, place, sizes):
	var array = _reference(value, place)
	if code != "":
		return null
	if array.dtype != type.words[0] or array.shape.size() != type.words.size() - 1:
		return _malformed("%s is an array of %s with %d sizes" % [place, array.dtype, array.shape.size()])
	for i in range(array.shape.size()):
		_agree(sizes, type.words[i + 1], array.shape[i], place)
	return array if code == "" else null


func _reference(value, place):
	if typeof(value) != TYPE_DICTIONARY or typeof(value.get("dtype")) != TYPE_STRING:
		return _malformed("%s is no reference to an array" % place)
	var shape = value.get("shape")
	var begin = value.get("offset")
	if typeof(shape) != TYPE_ARRAY or typeof(begin) != TYPE_INT or not WIDTHS.has(value["dtype"]):
		return _malformed("%s is no reference to an array" % place)
	if shape.size() > 6:
		return _fail("limit", "%s has %d dimensions; at most 6 may travel" % [place, shape.size()])
	# As floats: the product of sizes may exceed 64 bits, and a body never does.
	var length = WIDTHS[value["dtype"]] + 0.0
	for size in shape:
		if typeof(size) != TYPE_INT or size < 0:
			return _malformed("%s: the shape is no list of sizes" % place)
		length *= size
	if begin < _end or begin % 8 != 0 or length > _body.size() or begin > _body.size() - int(length):
		return _malformed("%s: the array at %d does not lie in its place of the body" % [place, begin])
	var found = NdArray.new()
	found.dtype = value["dtype"]
	found.shape = shape
	found.data = piece(_body, begin, int(length))
	_end = begin + int(length)
	if found.dtype == "|b1":
		for element in found.data:
			if element > 1:
				return _malformed("%s: a boolean is 0 or 1" % place)
	return found


# --- writing structs: canonical form, in which a field that equals its default is left out ------------------


func _written_struct(struct, map):
	var kept = []
	for field in struct.fields:
		var value = map.get(field.name)
		if value == null:
			if field.required:
				_malformed("%s has no %s" % [struct.name, field.name])
			continue
		var bytes = _written(field.type, value, "%s.%s" % [struct.name, field.name])
		if code != "":
			return null
		if field.required or field.left_out or not _is_standard(value, field, bytes):
			kept.append([field.name, bytes])
	var to = _big()
	_head(to, kept.size() + (1 if struct.tag != "" else 0), 0x80, 16, 0, 0xde, 0xdf)
	if struct.tag != "":
		_write_text(to, "type")
		_write_text(to, struct.tag)
	for pair in kept:
		_write_text(to, pair[0])
		to.put_data(pair[1])
	return to.data_array


static func _is_standard(value, field, bytes):
	var kind = field.type.kind
	if kind == "S":
		return bytes.size() == 1 and bytes[0] == 0x80
	if kind == "f":
		return _near(value, field.standard)
	if kind == "t":
		for i in range(field.standard.size()):
			if not _near(value[i], field.standard[i]):
				return false
		return true
	if kind == "l" or kind == "m":
		return value.size() == 0
	return value == field.standard


# Godot 3 reads decimals to 1 in 10^15: a default that was read equals one that was computed within that.
static func _near(a, b):
	return abs(a - b) <= 1e-14 * max(abs(a), abs(b))


func _written(type, value, place):
	var to = _big()
	if type.kind == "f":
		var number = value + 0.0
		if is_nan(number) or is_inf(number):
			return _malformed("%s is %s; it has to be finite" % [place, str(number)])
		_write(to, number)
	elif type.kind == "i":
		_write(to, int(value))
	elif type.kind == "l" or type.kind == "t":
		_head(to, value.size(), 0x90, 16, 0, 0xdc, 0xdd)
		for item in value:
			var bytes = _written(type.inner, item, place)
			if code != "":
				return null
			to.put_data(bytes)
	elif type.kind == "m":
		var keys = value.keys()
		keys.sort()
		_head(to, keys.size(), 0x80, 16, 0, 0xde, 0xdf)
		for key in keys:
			_write_text(to, key)
			to.put_data(_written(type.inner, value[key], place))
	elif type.kind == "S":
		return _written_struct(schema.structs[_member(type, value)], value)
	elif type.kind == "a":
		return _placed_array(value)
	else:
		_write(to, value)
	return to.data_array


func _placed_array(array):
	while _placed.get_size() % 8 != 0:
		_placed.put_u8(0)
	var to = _big()
	_head(to, 3, 0x80, 16, 0, 0xde, 0xdf)
	for pair in [["dtype", array.dtype], ["shape", array.shape], ["offset", _placed.get_size()]]:
		_write_text(to, pair[0])
		_write(to, pair[1])
	if array.data.size() > 0:
		_placed.put_data(array.data)
	return to.data_array


# --- messages and products ----------------------------------------------------------------------------------


func encode_message(type, fields):
	_clear()
	return _written_struct(schema.messages[type], fields)


# The fields of a message's first part, or null with a code.
func decode_message(header):
	_clear()
	if header.size() > MAX_HEADER:
		return _fail("limit", "the header has %d B; at most %d may travel" % [header.size(), MAX_HEADER])
	var map = unpack(header)
	if code != "":
		return null
	var type = map.get("type") if typeof(map) == TYPE_DICTIONARY else null
	if typeof(type) != TYPE_STRING or not schema.messages.has(type):
		return _malformed("no message is a '%s'" % str(type))
	var version = map.get("version")
	if (type == "HELLO" or type == "WELCOME") and typeof(version) == TYPE_ARRAY and version.size() == 2:
		if typeof(version[0]) == TYPE_INT and version[0] >= 0 and version[0] != 1:
			return _fail("version", "the peer speaks version %s of the protocol, this client 1.5" % str(version))
	return _read_struct(schema.messages[type], map, type)


# Whether a message has the parts that its header announces.
func check_parts(fields, parts):
	_clear()
	var type = fields["type"]
	var products = 0
	if type == "DONE":
		products = fields["products"].size()
	elif type == "GRANT" or type == "OBSERVE":
		for input in fields["inputs"]:
			products += 0 if input["status"] == "absent" else 1
	var raw = 1 if type == "ASSET_DATA" or type == "CHECKPOINT_DONE" or type == "RESTORE" else 0
	if parts.size() != 1 + 2 * products + raw:
		_malformed("%s has %d parts; its header announces %d" % [type, parts.size(), 1 + 2 * products + raw])
		return false
	for i in range(1, 2 * products, 2):
		if parts[i].size() > MAX_HEADER:
			_fail("limit", "a product's header has %d B; at most %d may travel" % [parts[i].size(), MAX_HEADER])
	if code == "" and type == "ASSET_DATA" and parts[1].size() > MAX_ASSET_CHUNK:
		_fail("limit", "ASSET_DATA brings %d B; at most %d may travel" % [parts[1].size(), MAX_ASSET_CHUNK])
	if code == "" and type == "ASSET_DATA" and fields["offset"] > fields["size"] - parts[1].size():
		_malformed("ASSET_DATA reaches beyond the size that it states")
	return code == ""


# {header, body, digest} of a product, or null with a message.
func encode_payload(topic, value):
	_clear()
	_placed = StreamPeerBuffer.new()
	var header = _written_struct(schema.topics[topic], value)
	if code != "":
		return null
	return {"header": header, "body": _placed.data_array, "digest": product_digest(header, _placed.data_array)}


# The fields of a product, with its arrays, or null with a code.
func decode_payload(topic, header, body):
	_clear()
	if header.size() > MAX_HEADER:
		return _fail("limit", "the header has %d B; at most %d may travel" % [header.size(), MAX_HEADER])
	if not schema.topics.has(topic):
		return _malformed("no topic is called '%s'" % topic)
	var map = unpack(header)
	if code != "":
		return null
	_body = body
	_end = 0
	return _read_struct(schema.topics[topic], map, topic)


# Arrays of a list of references, or null with a code.
func decode_arrays(references, body):
	var list = unpack(references)
	if code == "" and typeof(list) != TYPE_ARRAY:
		_malformed("no list of references")
	if code != "":
		return null
	_body = body
	_end = 0
	var found = []
	for reference in list:
		found.append(_reference(reference, "array"))
		if code != "":
			return null
	return found


# A message as one WebSocket frame.
static func join_frame(parts):
	var frame = StreamPeerBuffer.new()
	frame.put_u32(parts.size())
	for part in parts:
		frame.put_u32(part.size())
	for part in parts:
		if part.size() > 0:
			frame.put_data(part)
	return frame.data_array


# The parts of a WebSocket frame, or null with a code.
func split_frame(bytes):
	_clear()
	var frame = StreamPeerBuffer.new()
	frame.data_array = bytes
	var count = frame.get_u32() if bytes.size() >= 4 else 0
	if count < 1 or count > MAX_PARTS or bytes.size() < 4 * (1 + count):
		return _malformed("the frame states %d parts" % count)
	var lengths = []
	for _i in range(count):
		lengths.append(frame.get_u32())
	var parts = []
	var at = 4 * (1 + count)
	for length in lengths:
		if length > bytes.size() - at:
			return _malformed("a part of the frame ends past it")
		parts.append(piece(bytes, at, length))
		at += length
	return parts if at == bytes.size() else _malformed("the frame has bytes after its last part")
