# A WebSocket of Godot 3, and what else has another name in Godot 4, for which caviar_socket_4.gd is.

var _client = WebSocketClient.new()
var _queue = []
var _opened = false


# buffer_kb: of a message that comes, at most.
func open(url, token, buffer_kb):
	_client.set_buffers(buffer_kb, 64, buffer_kb, 64)
	# Browsers and exports to them have no headers: the token goes with the subprotocols.
	var protocols = ["caviar.v1", "bearer." + token] if token != "" else []
	_opened = _client.connect_to_url(url, PoolStringArray(protocols)) == OK


func poll():
	if not _opened:
		return
	_client.poll()
	if is_open():
		_client.get_peer(1).set_write_mode(WebSocketPeer.WRITE_MODE_BINARY)
		while _queue.size() > 0 and _client.get_peer(1).put_packet(_queue[0]) == OK:
			_queue.pop_front()


func is_open():
	return _opened and _client.get_connection_status() == NetworkedMultiplayerPeer.CONNECTION_CONNECTED


func is_closed():
	return not _opened or _client.get_connection_status() == NetworkedMultiplayerPeer.CONNECTION_DISCONNECTED


# The next message, or null.
func receive():
	if not is_open() or _client.get_peer(1).get_available_packet_count() == 0:
		return null
	return _client.get_peer(1).get_packet()


func send(bytes):
	_queue.append(bytes)
	poll()


# Send what is left and say goodbye; half a second at most.
func close():
	for i in range(50):
		poll()
		if i > 0 and _queue.size() == 0 and is_open():
			_client.disconnect_from_host(1000)
			_opened = true
		if is_closed():
			return
		OS.delay_msec(10)


func abort():
	_opened = false
	_client = null


static func ticks_ms():
	return OS.get_ticks_msec()


static func file_exists(path):
	return File.new().file_exists(path)
