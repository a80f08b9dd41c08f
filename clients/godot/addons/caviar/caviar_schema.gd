# Field types of all messages and payloads, from the text below that clients/schema.py makes and explains.
#
# One text for Godot 3 and 4: like all files here but the sockets it uses only what both have.

const TEXT = """
# schema: begin
Scene names:l(s) classes:l(s) assets:l(s) position:a(<f8,N,3) orientation:a(<f8,N,4) velocity:a(<f8,N,3) dimensions:a(<f8,N,3) devices:l(AntennaDevice/LidarDevice/CameraDevice)=[] angular_velocity:a(<f8,N,3)=?
Channel rung:s options:ChannelOptions={} expected_error_db:f=? carriers:l(Carrier) tx:l(s) rx:l(s) los:a(|b1,T,R) offsets:a(<i8,L1) object_names:l(s)=[] id:a(<u8,P) a:a(<c16,C,P) tau:a(<f8,P) aod:a(<f8,P,2) aoa:a(<f8,P,2) doppler:a(<f8,C,P) interactions:a(|u1,P,D) points:a(<f8,P,D,3) objects:a(<i4,P,D) h:l(ChannelMatrix)=[] dropped:i0=0 hf:l(ChannelResponse)=[] taps:l(ChannelTaps)=[] error_bound_db:a(<f8,T,R)=? error_reference:s='' used:a(|b1,C,T,R)=?
Lidar object_names:l(s) scans:l(LidarScan)
Camera images:l(CameraImage)
Depth images:l(DepthImage)
Segmentation object_names:l(s) material_names:l(s)=[] images:l(SegmentationImage)
Action commands:l(BeamChoice/WaypointCommand/VelocityCommand/UserSchedule/PathCommand/AttitudeCommand/DriveCommand/SignalCommand)
Link tx:l(s) rx:l(s) carrier:l(s) has_path:a(|b1,U) los:a(|b1,U) tx_beam:a(<i4,U) rx_beam:a(<i4,U) abs_y:a(<f8,U) top_tx_beam:a(<i4,U,K) top_rx_beam:a(<i4,U,K) top_abs_y:a(<f8,U,K) baseline_abs_y:a(<f8,U) aod_azimuth:a(<f8,U) aoa_azimuth:a(<f8,U) snr:a(<f8,U) snr_best:a(<f8,U) spectral_efficiency:a(<f8,U) bit_rate:a(<f8,U) reward:a(<f8,U) buffered:a(<f8,U)=? no_path:i0=0 serving:a(|b1,U)=? arrived:a(<i8,U)=? sent:a(<i8,U)=? dropped:a(<i8,U)=? delivered:a(<i8,U)=? delay:a(<f8,U)=? waiting:a(<f8,U)=? sinr:a(<f8,U)=? throughput:a(<f8,U)=? blocks:a(<i8,U)=? block_errors:a(<i8,U)=?
Hello:HELLO version:t2(i0) name:n role:e(world,channel,sensors,link,agent,recorder,observer) inputs:l256(Input)=[] outputs:l256(n)=[] capabilities:l256(s1..128)=[] implementation:s='' max_in_flight:i1..64=1 host:s='' pid:i0=0 subscriptions:l32(Subscription)=[]
Welcome:WELCOME version:t2(i0) run:s epoch:i1 attempt:i1 capabilities:l256(s1..128)=[] heartbeat_ns:i1 liveness_ns:i1 seed:i0=0 settings:m(*)={} scenario:m(*)={} rejoin_ns:i0=0
Refuse:REFUSE code:s1..128 message:s
Prepare:PREPARE epoch:i1 attempt:i1 demand:l256(Demand)=[] assets:l(Asset)=[] producers:m(l(s1..128))={} prefixes:m(l(s))={} max_faces:i0=0
AssetOffer:ASSET_OFFER epoch:i1 attempt:i1 assets:l(Asset)
AssetGet:ASSET_GET digest:d offset:i0=0
AssetData:ASSET_DATA digest:d offset:i0 size:i0
Ready:READY epoch:i1 attempt:i1 geometry:D='' prefixes:l(s)=[] actuators:l(s1..255)=[] notes:l(s)=[] seed:i-1=-1
Reset:RESET epoch:i1 attempt:i1 episode:i0 seed:i0 t0_ns:i seed_episode:i0=0
ResetDone:RESET_DONE epoch:i1 attempt:i1 episode:i0
Grant:GRANT epoch:i1 attempt:i1 episode:i0 frame:i0 previous_frame:i-1=-1 t_ns:i budget_ns:i0=0 inputs:l256(GrantInput)=[] final:b=false decisions:m(s)={} reports:l256(Report)=[]
Done:DONE epoch:i1 attempt:i1 episode:i0 frame:i0 products:l256(ProductHeader)=[] decisions:m(s)={} measured:m(i0)={} counts:m(i0)={} end_episode:b=false seed:i-1=-1 geometry:GeometryChange=? geometry_digest:D=''
Fault:FAULT epoch:i1 attempt:i1 episode:i0=0 frame:i-1=-1 phase:s message:s detail:s='' culprit:s=''
Cancel:CANCEL epoch:i1 attempt:i1 episode:i0 frame:i0
EpisodeEnd:EPISODE_END epoch:i1 attempt:i1 episode:i0 frames:i0
Checkpoint:CHECKPOINT epoch:i1 attempt:i1 episode:i0 frame:i0
CheckpointDone:CHECKPOINT_DONE epoch:i1 attempt:i1 episode:i0 frame:i0
Restore:RESTORE epoch:i1 attempt:i1 episode:i0 frame:i0
Geometry:GEOMETRY epoch:i1 attempt:i1 episode:i0 frame:i0 assets:l(Asset)=[]
GeometryDone:GEOMETRY_DONE epoch:i1 attempt:i1 episode:i0 frame:i0 geometry:D=''
Shutdown:SHUTDOWN reason:s grace_ns:i0=0
Bye:BYE epoch:i1 attempt:i1 reason:s=''
Stale:STALE of:s1..128 epoch:i1 attempt:i1 episode:i0 frame:i-1
Error:ERROR code:s1..128 message:s of:s='' subject:s=''
Observe:OBSERVE sequence:i0 state:s1..128 paused:b=false episode:i0=0 frame:i-1=-1 t_ns:i=0 inputs:l256(GrantInput)=[] reports:l256(Report)=[]
Observed:OBSERVED sequence:i0
Attach:ATTACH epoch:i1 attempt:i1 name:s1..128
Heartbeat:HEARTBEAT sequence:i0 progress:i0=0 phase:s='' grace_ns:i0=0
HeartbeatAck:HEARTBEAT_ACK sequence:i0
ChannelOptions los:b=true reflection:b=false refraction:b=false diffraction:b=false scattering:b=false max_depth:i0=0 samples:i0=0 materials_outside:l(s)=[] absorption_db_per_km:l(f0)=[] detail:s='' foliage:l(s)=[] blockage:l(s)=[]
Carrier name:s frequency_hz:f<0 bandwidth_hz:f<0=100000000.0 subcarriers:i0..65536=0 subcarrier_spacing_hz:f0=0.0 taps:i0..65536=0 slots:i1..65536=1 slot_duration_s:f0=0.0
ChannelMatrix carrier:i0 tx:i0 rx:i0 h:a(<c16,Nr,Nt)
ChannelResponse carrier:i0 tx:i0 rx:i0 h:a(<c8,S,K,Nr,Nt)
ChannelTaps carrier:i0 tx:i0 rx:i0 first:i h:a(<c8,S,L,Nr,Nt)
LidarScan sensor:s position:t3(f) orientation:t4(f) ray:a(<i4,N) points:a(<f4,N,3) points_world:a(<f4,N,3)=? range:a(<f4,N) object:a(<i4,N) grid:OccupancyGrid=?
CameraImage sensor:s intrinsics:Intrinsics position:t3(f) orientation:t4(f) rgb:a(|u1,H,W,3)
DepthImage sensor:s intrinsics:Intrinsics position:t3(f) orientation:t4(f) depth:a(<f4,H,W) normals:a(<f4,H,W,3)=?
SegmentationImage sensor:s intrinsics:Intrinsics position:t3(f) orientation:t4(f) object:a(<i4,H,W) material:a(<i4,H,W)=?
Asset name:p digest:d size:i0
GeometryChange frame:i0 assets:l(Asset)=[]
AntennaDevice:antenna name:s parent:s='' position:t3(f)=[0.0,0.0,0.0] orientation:t4(f)=[1.0,0.0,0.0,0.0] role:e(tx,rx,both) array:AntennaArray={} power_dbm:f=0.0 carriers:l(s)=[]
LidarDevice:lidar name:s parent:s='' position:t3(f)=[0.0,0.0,0.0] orientation:t4(f)=[1.0,0.0,0.0,0.0] beams:i1..1024=64 azimuth_steps:i1..36000=1800 elevation_min:f=-0.4363323129985824 elevation_max:f=0.05235987755982989 max_range:f<0=100.0 min_range:f0=0.0
CameraDevice:camera name:s parent:s='' position:t3(f)=[0.0,0.0,0.0] orientation:t4(f)=[1.0,0.0,0.0,0.0] width:i1..8192=640 height:i1..8192=480 field_of_view:f<0=1.5707963267948966
Intrinsics fx:f fy:f cx:f cy:f
BeamChoice:beam tx:s rx:s tx_beam:i0 rx_beam:i0=0 carrier:s=''
WaypointCommand:waypoint object:s position:t3(f) speed:f<0 at_once:b=false yaw:f=?
VelocityCommand:velocity object:s velocity:t3(f) yaw:f=? yaw_rate:f=?
UserSchedule:schedule tx:s rx:s
PathCommand:path object:s points:l(t3(f)) speed:f<0
AttitudeCommand:attitude object:s orientation:t4(f) thrust:f0
DriveCommand:drive object:s speed:f0=? lane:i0=? route:l(s)=[] stop:RoadStop=?
SignalCommand:signal signal:s phase:i0 duration:f<0=?
Input topic:n lag:i0..1=0 required:b=true parts:l256(s1..128)=[]
Subscription topic:n source:s='' every:i1=1
Demand topic:s1..128 parts:l256(s1..128)=[]
GrantInput topic:s1..128 source:s1..128 status:e(fresh,held,absent,late) frame:i-1=-1 t_ns:i=0 age:i0=0 fidelity:s='' digest:D='' cause:s='' geometry:D=''
Report source:s1..128 decisions:m(s)={} measured:m(i0)={} counts:m(i0)={} geometry:GeometryChange=?
ProductHeader topic:s1..128 digest:d fidelity:s=''
AntennaArray rows:i1..1024=1 columns:i1..1024=1 vertical_spacing:f<0=0.5 horizontal_spacing:f<0=0.5 pattern:e(iso,dipole,hw_dipole,tr38901)='iso' polarization:e(V,H,-45,+45,RHCP,LHCP,VH,cross,circular)='V' pattern_file:s='' panels:l(Panel)=[] codebook:s='dft'
OccupancyGrid origin:t3(f) cell:t3(f) occupancy:a(|i1,X,Y,Z)
RoadStop road:s position:f0 duration:f0 lane:i0=0
Panel position_m:t3(f)=[0.0,0.0,0.0] yaw_deg:f=0.0 pitch_deg:f=0.0 roll_deg:f=0.0
=Scene N:names,classes,assets
=Channel C:carriers
=Channel T:tx
=Channel R:rx
=Link U:tx,rx,carrier
@topics scene:Scene channel:Channel lidar:Lidar camera:Camera depth:Depth segmentation:Segmentation action:Action link:Link
# schema: end
"""

var structs = {}  # name: {name, tag, fields, sizes}
var messages = {}  # type: struct
var topics = {}  # topic: struct


func _init():
	for line in TEXT.split("\n"):
		if line == "" or line.begins_with("#"):
			continue
		var words = line.split(" ")
		if line.begins_with("="):
			for i in range(1, words.size()):
				var size = words[i].split(":")
				structs[words[0].substr(1, words[0].length() - 1)].sizes[size[0]] = size[1].split(",")
		elif line.begins_with("@"):
			for i in range(1, words.size()):
				topics[words[i].split(":")[0]] = structs[words[i].split(":")[1]]
		else:
			_add_struct(words)


func _add_struct(words):
	var head = words[0].split(":")
	var made = {"name": head[0], "tag": head[1] if head.size() > 1 else "", "fields": [], "sizes": {}}
	structs[head[0]] = made
	if made.tag != "" and made.tag == made.tag.to_upper():
		messages[made.tag] = made
	for i in range(1, words.size()):
		var colon = words[i].find(":")
		var equals = words[i].find("=", colon)
		var text = words[i].substr(colon + 1, (equals if equals >= 0 else words[i].length()) - colon - 1)
		var field = {"name": words[i].substr(0, colon), "type": _type(text), "required": equals < 0}
		field["left_out"] = false
		if equals >= 0:
			var standard = words[i].substr(equals + 1, words[i].length() - equals - 1)
			field.left_out = standard == "?"
			field["standard"] = null if field.left_out else _standard(standard, field.type)
		made.fields.append(field)


func _type(text):
	var made = {"kind": text[0], "low": null, "high": null, "above": false, "fewest": 0, "most": 1 << 40}
	var open = text.find("(")
	var head = text.substr(1, (open if open >= 0 else text.length()) - 1)
	var inner = text.substr(open + 1, text.length() - open - 2) if open >= 0 else ""
	# Structs have names with a capital; D alone is a digest or empty.
	if text != "D" and text[0] == text[0].to_upper() and text[0] != "*":
		made.kind = "S"
		made["words"] = text.split("/")
	elif text[0] == "l" or text[0] == "t" or text[0] == "m":
		made["inner"] = _type(inner)
		if head != "":
			made.most = head.to_int()
		if text[0] == "t":
			made.fewest = made.most
	elif text[0] == "e" or text[0] == "a":
		made["words"] = inner.split(",")
	elif text[0] == "s" and head != "":
		made.fewest = head.split("..")[0].to_int()
		made.most = head.split("..")[1].to_int()
	elif head != "":
		made.above = head[0] == "<"
		var ends = head.replace("<", "").split("..")
		made.low = ends[0].to_int()
		if ends.size() > 1:
			made.high = ends[1].to_int()
	return made


func _standard(text, type):
	if type.kind == "b":
		return text == "true"
	if type.kind == "i":
		return text.to_int()
	if type.kind == "f":
		return _number(text)
	if type.kind == "l":
		return []
	if type.kind == "t":
		var found = []
		for item in text.substr(1, text.length() - 2).split(","):
			found.append(_number(item))
		return found
	if type.kind == "m" or type.kind == "S":
		return {}
	return text.substr(1, text.length() - 2)


# String.to_float has single precision in Godot 3.
static func _number(text):
	var expression = Expression.new()
	expression.parse(text)
	return expression.execute() + 0.0
