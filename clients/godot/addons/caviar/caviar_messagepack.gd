# MessagePack as the protocol has it: no binary, no extensions; floats stay floats. And bytes, and digests.
#
# GDScript has no exceptions: what is refused returns null (or false), and `code` and `message` say why.

const FLOAT = TYPE_INT + 1  # its name is another one in Godot 4
const MAX_NESTING = 32

var code = ""  # malformed, limit or version
var message = ""


func _fail(with_code, why):
	if code == "":
		code = with_code
		message = why
	return null


func _malformed(why):
	return _fail("malformed", why)


func _clear():
	code = ""
	message = ""


# --- bytes --------------------------------------------------------------------------------------------------


static func utf8(text):
	var buffer = StreamPeerBuffer.new()
	buffer.put_utf8_string(text)
	return piece(buffer.data_array, 4, buffer.get_size() - 4)


static func piece(bytes, from, count):
	var buffer = StreamPeerBuffer.new()
	if count <= 0:
		return buffer.data_array
	buffer.data_array = bytes
	buffer.seek(from)
	return buffer.get_data(count)[1]


static func joined(pieces):
	var buffer = StreamPeerBuffer.new()
	for bytes in pieces:
		if bytes.size() > 0:
			buffer.put_data(bytes)
	return buffer.data_array


static func sha256(pieces):
	var hashing = HashingContext.new()
	hashing.start(HashingContext.HASH_SHA256)
	for bytes in pieces:
		if bytes.size() > 0:
			hashing.update(bytes)
	return hashing.finish().hex_encode()


static func product_digest(header, body):
	var length = StreamPeerBuffer.new()
	length.put_64(header.size())
	return sha256([length.data_array, header, body])


# --- writing MessagePack ------------------------------------------------------------------------------------


func pack(value):
	var to = _big()
	_write(to, value)
	return to.data_array


static func _big():
	var buffer = StreamPeerBuffer.new()
	buffer.big_endian = true
	return buffer


func _write(to, value):
	var kind = typeof(value)
	if value == null:
		to.put_u8(0xc0)
	elif kind == TYPE_BOOL:
		to.put_u8(0xc3 if value else 0xc2)
	elif kind == FLOAT:
		to.put_u8(0xcb)
		to.put_double(value + 0.0)
	elif kind == TYPE_INT:
		_write_int(to, value)
	elif kind == TYPE_STRING:
		_write_text(to, value)
	elif kind == TYPE_DICTIONARY:
		_head(to, value.size(), 0x80, 16, 0, 0xde, 0xdf)
		var keys = value.keys()
		keys.sort()  # by code points, which is the order of the UTF-8 bytes
		for key in keys:
			_write_text(to, key)
			_write(to, value[key])
	else:
		_head(to, value.size(), 0x90, 16, 0, 0xdc, 0xdd)
		for item in value:
			_write(to, item)


static func _head(to, count, small, below, one, two, four):
	if count < below:
		to.put_u8(small | count)
	elif one != 0 and count < 0x100:
		to.put_u8(one)
		to.put_u8(count)
	elif count < 0x10000:
		to.put_u8(two)
		to.put_u16(count)
	else:
		to.put_u8(four)
		to.put_u32(count)


static func _write_text(to, text):
	var bytes = utf8(text)
	_head(to, bytes.size(), 0xa0, 32, 0xd9, 0xda, 0xdb)
	if bytes.size() > 0:
		to.put_data(bytes)


static func _write_int(to, value):
	if value >= 0 and value < 0x80:
		to.put_u8(value)
	elif value >= 0 and value < 0x100:
		to.put_u8(0xcc)
		to.put_u8(value)
	elif value >= 0 and value < 0x10000:
		to.put_u8(0xcd)
		to.put_u16(value)
	elif value >= 0 and value < 0x100000000:
		to.put_u8(0xce)
		to.put_u32(value)
	elif value >= 0:
		to.put_u8(0xcf)
		to.put_64(value)
	elif value >= -32:
		to.put_8(value)
	elif value >= -0x80:
		to.put_u8(0xd0)
		to.put_8(value)
	elif value >= -0x8000:
		to.put_u8(0xd1)
		to.put_16(value)
	elif value >= -0x80000000:
		to.put_u8(0xd2)
		to.put_32(value)
	else:
		to.put_u8(0xd3)
		to.put_64(value)


# --- reading MessagePack ------------------------------------------------------------------------------------


# One value that fills all bytes; null with a code where it does not.
func unpack(bytes):
	_clear()
	var from = _big()
	from.data_array = bytes
	var found = _read(from, 0)
	if code == "" and from.get_position() != bytes.size():
		_malformed("bytes after the end of the header")
	return found if code == "" else null


func _left(from):
	return from.get_size() - from.get_position()


func _has(from, count):
	if count > _left(from):
		_malformed("the header ends in the middle of a value")
	return code == ""


func _read(from, depth):
	if not _has(from, 1):
		return null
	var first = from.get_u8()
	if first < 0x80:
		return first
	if first >= 0xe0:
		return first - 0x100
	if first < 0x90:
		return _read_map(from, first & 0x0f, depth)
	if first < 0xa0:
		return _read_list(from, first & 0x0f, depth)
	if first < 0xc0:
		return _read_text(from, first & 0x1f)
	if first == 0xc0:
		return null
	if first == 0xc2 or first == 0xc3:
		return first == 0xc3
	if first == 0xca:
		return from.get_float() if _has(from, 4) else null
	if first == 0xcb:
		return from.get_double() if _has(from, 8) else null
	if first >= 0xcc and first <= 0xd3:
		return _read_int(from, first)
	if first >= 0xd9 and first <= 0xdb:
		return _read_text(from, _read_int(from, 0xcc + first - 0xd9))
	if first == 0xdc or first == 0xdd:
		return _read_list(from, _read_int(from, 0xcd + first - 0xdc), depth)
	if first == 0xde or first == 0xdf:
		return _read_map(from, _read_int(from, 0xcd + first - 0xde), depth)
	return _malformed("the byte 0x%02x begins no value of a header" % first)


func _read_int(from, kind):
	var signed = kind >= 0xd0
	var width = 1 << (kind - (0xd0 if signed else 0xcc))
	if not _has(from, width):
		return 0
	if width == 1:
		return from.get_8() if signed else from.get_u8()
	if width == 2:
		return from.get_16() if signed else from.get_u16()
	if width == 4:
		return from.get_32() if signed else from.get_u32()
	var found = from.get_64()
	if found < 0 and not signed:
		_malformed("an integer does not fit into 64 bits with a sign")
	return found


func _read_text(from, count):
	if code != "" or not _has(from, count):
		return null
	if count == 0:
		return ""
	var begin = from.get_position()
	var text = from.get_utf8_string(count)
	# Godot makes something of any bytes: those that are no UTF-8 come back as others.
	if utf8(text) != piece(from.data_array, begin, count):
		return _malformed("a string is not UTF-8")
	return text


# A count costs nothing before its items are there: each takes a byte at least.
func _check_count(from, count, depth):
	if code == "" and depth >= MAX_NESTING:
		_fail("limit", "maps and lists nest deeper than %d" % MAX_NESTING)
	elif code == "" and count > _left(from):
		_malformed("a length announces more items than there are bytes")
	return code == ""


func _read_list(from, count, depth):
	if not _check_count(from, count, depth):
		return null
	var found = []
	for _i in range(count):
		found.append(_read(from, depth + 1))
		if code != "":
			return null
	return found


func _read_map(from, count, depth):
	if not _check_count(from, count, depth):
		return null
	var found = {}
	for _i in range(count):
		var key = _read(from, depth + 1)
		if code == "" and typeof(key) != TYPE_STRING:
			_malformed("the key of a map is no string")
		if code != "":
			return null
		found[key] = _read(from, depth + 1)
	return found if code == "" else null
