# The heartbeat connection. It beats when the world is polled: while the engine computes, none is missed.

const Codec = preload("caviar_codec.gd")

var lost = ""  # why the broker counts as lost
var phase = ""
var progress = 0
var _codec
var _socket
var _period
var _liveness
var _sequence = 0
var _beat = 0
var _silence = 0  # ms that were polled without a word
var _polled


func _init(codec, socket, welcome):
	_codec = codec
	_socket = socket
	_period = max(1, welcome["heartbeat_ns"] / 1000000)
	_liveness = welcome["liveness_ns"] / 1000000


func begin(url, token, epoch, attempt, name):
	_socket.open(url, token, 64)
	_socket.send(_frame("ATTACH", {"epoch": epoch, "attempt": attempt, "name": name}))
	_polled = _socket.ticks_ms()
	_beat = _polled + _period


func _frame(type, fields):
	return Codec.join_frame([_codec.encode_message(type, fields)])


func poll():
	_socket.poll()
	var now = _socket.ticks_ms()
	# A tick that took long is the engine's silence, not the broker's: its words wait in the socket.
	_silence += min(now - _polled, _period)
	_polled = now
	var bytes = _socket.receive()
	while bytes != null:
		_silence = 0
		_look(bytes)
		bytes = _socket.receive()
	if _socket.is_closed():
		lost = "the heartbeat connection is lost"
	elif _silence > _liveness:
		lost = "the broker is silent, for %d ms" % _silence
	elif now >= _beat and lost == "":
		_beat = max(_beat + _period, now)
		_socket.send(_frame("HEARTBEAT", {"sequence": _sequence, "progress": progress, "phase": phase}))
		_sequence += 1


func _look(bytes):
	var parts = _codec.split_frame(bytes)
	var fields = _codec.decode_message(parts[0]) if parts != null else null
	if fields != null and (fields["type"] == "ERROR" or fields["type"] == "REFUSE"):
		lost = "%s: %s" % [fields["code"], fields["message"]]
	# What cannot be read is noise: the next heartbeat asks again.


func stop():
	if lost == "":
		_socket.close()
	else:
		_socket.abort()
