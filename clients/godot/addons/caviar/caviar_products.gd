# What other services made, as lists of dictionaries: decoded products have their arrays as NdArray.


# The users of a product of `link`: tx, rx, carrier, and every array that has an element for each user.
static func users(link):
	var found = []
	var columns = {}
	for field in link:
		if typeof(link[field]) == TYPE_OBJECT and link[field].shape.size() == 1:
			columns[field] = link[field].to_ints() if link[field].dtype[1] != "f" else link[field].to_floats()
	for i in range(link["tx"].size()):
		var user = {"tx": link["tx"][i], "rx": link["rx"][i], "carrier": link["carrier"][i]}
		for field in columns:
			user[field] = columns[field][i]
		found.append(user)
	return found


# The paths of a product of `channel`, pair by pair: tx, rx, tau [s], aod and aoa as [zenith, azimuth]
# [rad]; for each carrier real and imaginary part of its amplitude and its doppler [Hz]; interactions and
# their points [m].
static func paths(channel):
	var a = channel["a"].to_floats()
	var tau = channel["tau"].to_floats()
	var doppler = channel["doppler"].to_floats()
	var aod = channel["aod"].to_floats()
	var aoa = channel["aoa"].to_floats()
	var kinds = channel["interactions"].to_ints()
	var points = channel["points"].to_floats()
	var offsets = channel["offsets"].to_ints()
	var depth = channel["interactions"].shape[1]
	var receivers = channel["rx"].size()
	var found = []
	for pair in range(offsets.size() - 1):
		for p in range(offsets[pair], offsets[pair + 1]):
			var path = {
				"tx": channel["tx"][pair / receivers], "rx": channel["rx"][pair % receivers], "tau": tau[p],
				"aod": [aod[2 * p], aod[2 * p + 1]], "aoa": [aoa[2 * p], aoa[2 * p + 1]],
				"real": [], "imaginary": [], "doppler": [], "interactions": [], "points": [],
			}
			for c in range(channel["carriers"].size()):
				path["real"].append(a[2 * (c * tau.size() + p)])
				path["imaginary"].append(a[2 * (c * tau.size() + p) + 1])
				path["doppler"].append(doppler[c * tau.size() + p])
			for i in range(p * depth, (p + 1) * depth):
				if kinds[i] != 0:
					path["interactions"].append(kinds[i])
					path["points"].append([points[3 * i], points[3 * i + 1], points[3 * i + 2]])
			found.append(path)
	return found
