# A WebSocket of Godot 4, and what else has another name in Godot 3, for which caviar_socket_3.gd is.

var _peer = WebSocketPeer.new()
var _queue = []
var _opened = false


# buffer_kb: of a message that comes, at most.
func open(url, token, buffer_kb):
	_peer.inbound_buffer_size = buffer_kb * 1024
	_peer.outbound_buffer_size = buffer_kb * 1024
	# Browsers and exports to them have no headers: the token goes with the subprotocols.
	if token != "":
		_peer.supported_protocols = PackedStringArray(["caviar.v1", "bearer." + token])
	_opened = _peer.connect_to_url(url) == OK


func poll():
	if not _opened:
		return
	_peer.poll()
	while is_open() and _queue.size() > 0 and _peer.send(_queue[0]) == OK:
		_queue.pop_front()


func is_open():
	return _opened and _peer.get_ready_state() == WebSocketPeer.STATE_OPEN


func is_closed():
	return not _opened or _peer.get_ready_state() == WebSocketPeer.STATE_CLOSED


# The next message, or null.
func receive():
	if not is_open() or _peer.get_available_packet_count() == 0:
		return null
	return _peer.get_packet()


func send(bytes):
	_queue.append(bytes)
	poll()


# Send what is left and say goodbye; half a second at most.
func close():
	for i in range(50):
		poll()
		if i > 0 and _queue.size() == 0 and is_open():
			_peer.close(1000)
		if is_closed():
			return
		OS.delay_msec(10)


func abort():
	_opened = false
	_peer = null


static func ticks_ms():
	return Time.get_ticks_msec()


static func file_exists(path):
	return FileAccess.file_exists(path)
