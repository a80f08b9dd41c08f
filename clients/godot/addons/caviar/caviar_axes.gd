# Axes and units of engines, to and from those of the protocol: east, north, up in metres; bodies have x
# forward, y left, z up.
#
#     var axes = Axes.new("godot")
#     var pose = axes.pose_to_enu(position, orientation)  # arrays of floats: [x, y, z], [w, x, y, z]
#
# Arrays and not Vector3: those of Godot have single precision.

const WORLDS = {
	"unreal": [[1, 0, 0], [0, -1, 0], [0, 0, 1]],  # left-handed cm: x east and forward, y south and right, z up
	"unity": [[0, -1, 0], [0, 0, 1], [1, 0, 0]],  # left-handed: x south and right, y up, z east and forward
	"godot": [[0, -1, 0], [0, 0, 1], [-1, 0, 0]],  # right-handed: x south and right, y up, z west and back
	"ned": [[0, 1, 0], [1, 0, 0], [0, 0, -1]],  # north, east, down
}
const BODIES = {"ned": [[1, 0, 0], [0, -1, 0], [0, 0, -1]]}  # forward, right, down; others as their worlds
const CLOCKWISE = ["unity", "godot"]  # triangles as seen from outside; in Unreal they are counter-clockwise

var _world
var _body
var _clockwise
var _hand
var _unit
var _left
var _right


func _init(engine):
	_world = WORLDS[engine]
	_body = BODIES.get(engine, _world)
	_clockwise = engine in CLOCKWISE
	_unit = 100.0 if engine == "unreal" else 1.0
	_hand = _determinant(_world)
	# W·R·Bᵀ with W = s·P and B = s·Q, P and Q rotations and s = ±1: the sign cancels.
	_left = quaternion_of(_scaled(_world, _hand))
	_right = inverse(quaternion_of(_scaled(_body, _hand)))


# {position, orientation} of the engine in the protocol's axes.
func pose_to_enu(position, orientation):
	var turned = multiply(multiply(inverse(_left), orientation), inverse(_right))
	return {"position": _back(position, 1.0 / _unit), "orientation": turned}


func pose_from_enu(position, orientation):
	var turned = multiply(multiply(_left, orientation), _right)
	return {"position": _forth(position, _unit), "orientation": turned}


# {velocity, angular_velocity}; the latter turns by the hand of the axes.
func motion_to_enu(velocity, angular_velocity = [0.0, 0.0, 0.0]):
	return {"velocity": _back(velocity, 1.0 / _unit), "angular_velocity": _back(angular_velocity, _hand)}


func motion_from_enu(velocity, angular_velocity = [0.0, 0.0, 0.0]):
	return {"velocity": _forth(velocity, _unit), "angular_velocity": _forth(angular_velocity, _hand)}


# {position, orientation} in the protocol's axes of a node's global transform, whatever its scale.
func transform_to_enu(transform):
	var basis = transform.basis
	var columns = [basis.x.normalized(), basis.y.normalized(), basis.z.normalized()]
	var matrix = []
	for i in range(3):
		matrix.append([columns[0][i], columns[1][i], columns[2][i]])
	return pose_to_enu(vector(transform.origin), quaternion_of(matrix))


# {vertices, triangles} for offer_mesh, forward, left, up [m] and counter-clockwise as seen from outside, of a mesh as
# the engine gives it: in its body axes, unit and winding. Corners: [[a, b, c], ...]; the second and third change
# places where the engine has them clockwise.
func mesh_to_enu(vertices, triangles):
	var found = {"vertices": [], "triangles": []}
	for vertex in vertices:
		found["vertices"].append(_back(vertex, 1.0 / _unit, _body))
	for corners in triangles:
		found["triangles"].append([corners[0], corners[2], corners[1]] if _clockwise else corners)
	return found


# A Vector3 as [x, y, z].
static func vector(of):
	return [of.x, of.y, of.z]


func _forth(v, factor):
	var found = []
	for row in _world:
		found.append(factor * (row[0] * v[0] + row[1] * v[1] + row[2] * v[2]) + 0.0)
	return found


func _back(v, factor, rows = _world):
	var found = []
	for i in range(3):
		found.append(factor * (rows[0][i] * v[0] + rows[1][i] * v[1] + rows[2][i] * v[2]) + 0.0)
	return found


static func _determinant(m):
	return (
		m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1])
		- m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
		+ m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
	)


static func _scaled(matrix, factor):
	var found = []
	for row in matrix:
		found.append([factor * row[0], factor * row[1], factor * row[2]])
	return found


# Quaternions are [w, x, y, z].
static func multiply(a, b):
	return [
		a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
		a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
		a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
		a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
	]


static func inverse(q):
	return [q[0], -q[1], -q[2], -q[3]]


# Of a rotation matrix. The greatest component comes from the diagonal, the others from it: no small divisor.
static func quaternion_of(m):
	var a = [m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]]
	var s = [m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]]
	var squares = [
		1.0 + m[0][0] + m[1][1] + m[2][2], 1.0 + m[0][0] - m[1][1] - m[2][2],
		1.0 - m[0][0] + m[1][1] - m[2][2], 1.0 - m[0][0] - m[1][1] + m[2][2],
	]
	var rows = [
		[squares[0], a[0], a[1], a[2]], [a[0], squares[1], s[0], s[1]],
		[a[1], s[0], squares[2], s[2]], [a[2], s[1], s[2], squares[3]],
	]
	var greatest = 0
	for i in range(1, 4):
		if squares[i] > squares[greatest]:
			greatest = i
	var found = []
	var length = 0.0
	for part in rows[greatest]:
		length += part * part
	for part in rows[greatest]:
		found.append(part / sqrt(length))
	return found


# Intrinsic z–y′–x″ [rad]: yaw counter-clockwise, then pitch, positive lowers the nose, then roll.
static func from_euler(yaw, pitch = 0.0, roll = 0.0):
	var cy = cos(yaw / 2)
	var sy = sin(yaw / 2)
	var cp = cos(pitch / 2)
	var sp = sin(pitch / 2)
	var cr = cos(roll / 2)
	var sr = sin(roll / 2)
	return [
		cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr,
		cy * sp * cr + sy * cp * sr, sy * cp * cr - cy * sp * sr,
	]
