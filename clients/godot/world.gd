extends SceneTree
# A world with the add-on: a car on a circle, a UAV that agents may steer, a van that comes and goes.
#
#     godot3-server -s world.gd ws://127.0.0.1:8080/ws world
#
# A token of the service, where the broker has tokens, is taken from CAVIAR_TOKEN.

const Axes = preload("res://addons/caviar/caviar_axes.gd")

var street = Street.new()


class Street:
	extends "res://addons/caviar/caviar_world.gd"
	const RADIUS = 20.0  # of the car [m]
	const SPEED = 10.0  # [m/s]
	# A wedge: x forward, y left, z up, in any unit.
	const WEDGE = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 1], [-1, 1, 1]]
	const SIDES = [[0, 3, 2], [0, 2, 1], [0, 1, 4], [3, 5, 2], [0, 4, 5], [0, 5, 3], [1, 2, 5], [1, 5, 4]]
	var mesh = {}
	var uav = []  # position [m]
	var wanted = null  # velocity that was commanded [m/s], or null

	func prepare():
		prefixes = ["car", "uav", "van"]
		mesh = offer_mesh("car", WEDGE, SIDES)
		var ground = [[-60, -60, 0], [60, -60, 0], [60, 60, 0], [-60, 60, 0]]
		var wall = [[30, 30, 0], [30, -30, 0], [30, -30, 12], [30, 30, 12]]
		var square = [[0, 1, 2], [0, 2, 3]]
		offer_scenery(
			[
				{"name": "ground", "vertices": ground, "triangles": square, "material": "asphalt"},
				{"name": "wall", "vertices": wall, "triangles": square, "material": "brick"},
			],
			[{"name": "asphalt", "type": "concrete"}, {"name": "brick", "type": "brick", "thickness": 0.3}]
		)

	func reset(seed_of_run, _t0):
		uav = [5.0, -5.0 - seed_of_run % 7, 15.0]
		wanted = null

	func step(t, previous, commands):
		for command in commands:
			if command["type"] == "velocity" and command["object"] == "uav":
				wanted = command["velocity"]
		var velocity = wanted if wanted != null else [3 * cos(0.4 * t), 3 * sin(0.4 * t), 0.0]
		for i in range(3):
			uav[i] += velocity[i] * (t - previous)
		var turning = SPEED / RADIUS
		var heading = turning * t + PI / 2
		var place = [RADIUS * cos(turning * t), RADIUS * sin(turning * t), 0.75]
		var car = object("car", "car", place, [4.5, 1.8, 1.5])
		car["orientation"] = Axes.from_euler(heading)
		car["velocity"] = [SPEED * cos(heading), SPEED * sin(heading), 0.0]
		car["angular_velocity"] = [0.0, 0.0, turning]
		car["mesh"] = mesh["mesh"]
		var flying = object("uav", "uav", uav.duplicate(), [0.6, 0.6, 0.25])
		flying["velocity"] = velocity
		var passing = fmod(t, 10.0) - 2.0  # of the van: it is there from 2 s until 7 s of every 10 s
		if passing < 0 or passing >= 5:
			return [car, flying]
		var van = object("van", "truck", [-40.0 + 16.0 * passing, 26.0, 1.25], [5.5, 2.1, 2.5])
		van["velocity"] = [16.0, 0.0, 0.0]
		van["mesh"] = offer_mesh("van", WEDGE, SIDES, "metal")["mesh"]  # it comes while the run goes on
		return [car, flying, van]

	func save():
		return var_to_state([uav, wanted])

	func restore(bytes):
		var state = state_to_var(bytes)
		uav = state[0]
		wanted = state[1]


func _init():
	var arguments = OS.get_cmdline_args()
	OS.low_processor_usage_mode = true
	OS.low_processor_usage_mode_sleep_usec = 1000
	street.inputs = ["action"]
	var count = arguments.size()
	street.connect_to(arguments[count - 2], arguments[count - 1], OS.get_environment("CAVIAR_TOKEN"))


func _idle(_delta):  # of Godot 3
	if not street.poll():
		quit(street.exit_status)


func _process(_delta):  # of Godot 4
	_idle(_delta)
