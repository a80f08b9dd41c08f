extends SceneTree
# A world that takes three ticks for a frame, and in frame 5 has an object whose name no prefix begins.

var slow = Slow.new()


class Slow:
	extends "res://addons/caviar/caviar_world.gd"
	var ticks = 0

	func prepare():
		prefixes = ["car"]

	func step(t, _previous_t, _commands):
		ticks += 1
		if ticks % 3 != 0:
			return WAIT
		return [object("car" if frame < 5 else "lorry", "car", [t, ticks + 0.0, 0.75], [4.5, 1.8, 1.5])]


func _init():
	var arguments = OS.get_cmdline_args()
	slow.connect_to(arguments[arguments.size() - 2], arguments[arguments.size() - 1])


func _idle(_delta):
	if not slow.poll():
		quit(slow.exit_status)
