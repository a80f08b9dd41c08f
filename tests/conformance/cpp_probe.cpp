// Answers questions about caviar.hpp, one a line of standard input, with one line of JSON each.
//
//     message PART…                       decode a message
//     payload TOPIC HEADER BODY           decode a product; its typed reading, where there is one
//     arrays HEADER BODY                  read a list of references
//     mounts WELCOME                      adopt the devices of a WELCOME
//     scene HEADER BODY NAME,NAME…        the scene of the objects of a scene, in the order in which they
//                                         came
//     axes ENGINE from|to NUMBER×13       a pose from ENU, or to it
//     engine_mesh ENGINE N NUMBER×N CORNER…  a mesh to ENU: its N coordinates, its corners
//     match PATTERN TEXT
//     digest HEADER BODY
//     geometry NAME DATA NAME DATA…
//     schema                              the types of messages and payloads
//
// Bytes are hexadecimal digits behind an `x`, or `zeros:N`. With an endpoint and a name it is a world that
// its settings set: `how` that its steps fail or are late, `wrong` says what is wrong with its object, `deferred` that it answers frames later, as
// an engine does, and it looks at links and channels. `spawn` has its car bring a mesh in frames 1 to 3, which
// is `right`, or wrong in one of several ways.
#include <iostream>
#include <sstream>

#include "caviar.hpp"

using caviar::Bytes;
using caviar::Value;

static Bytes bytes(const std::string& word) {
  if (word.rfind("zeros:", 0) == 0) return Bytes(std::stoul(word.substr(6)), '\0');
  Bytes found;
  for (std::size_t i = 1; i + 1 < word.size(); i += 2)
    found += static_cast<char>(std::strtol(word.substr(i, 2).c_str(), nullptr, 16));
  return found;
}

static std::string hex(const Bytes& data) {
  std::string text;
  for (const char byte : data) {
    text += "0123456789abcdef"[static_cast<std::uint8_t>(byte) >> 4];
    text += "0123456789abcdef"[byte & 15];
  }
  return "\"" + text + "\"";
}

static std::string json(double number) {
  char text[32];
  std::snprintf(text, sizeof text, "%.17g", number);
  return std::strpbrk(text, ".en") ? text : std::string(text) + ".0";
}

static std::string json(const std::string& text) {
  std::string out = "\"";
  for (const char character : text) {
    char code[8];
    const bool plain = static_cast<std::uint8_t>(character) >= 0x20 && character != '"' && character != '\\';
    std::snprintf(code, sizeof code, "\\u%04x", static_cast<unsigned>(static_cast<std::uint8_t>(character)));
    out += plain ? std::string(1, character) : code;
  }
  return out + "\"";
}

static std::string json(const Value& value) {
  std::string out;
  const auto& items = value.items();
  switch (value.kind()) {
    case Value::Kind::none:
      return "null";
    case Value::Kind::boolean:
      return value.boolean() ? "true" : "false";
    case Value::Kind::integer:
      return std::to_string(value.integer());
    case Value::Kind::number:
      return json(value.number());
    case Value::Kind::text:
      return json(value.text());
    case Value::Kind::array:
      for (const Value& size : items) out += (out.empty() ? "" : ", ") + std::to_string(size.integer());
      return "{\"dtype\": " + json(std::string(value.element().code)) + ", \"shape\": [" + out +
             "], \"data\": " + hex(value.data()) + "}";
    case Value::Kind::list:
      for (const Value& item : items) out += (out.empty() ? "" : ", ") + json(item);
      return "[" + out + "]";
    case Value::Kind::map:
      for (std::size_t i = 0; i < items.size(); i += 2)
        out += (out.empty() ? "" : ", ") + json(items[i]) + ": " + json(items[i + 1]);
      return "{" + out + "}";
  }
  return out;
}

template <typename Numbers>
static Value list(const Numbers& numbers) {
  return Value::list({numbers.begin(), numbers.end()});
}

static Value of(const caviar::Command& command) {
  return Value::map({{"kind", static_cast<int>(command.kind)},
                     {"source", command.source},
                     {"tx", command.tx},
                     {"rx", command.rx},
                     {"carrier", command.carrier},
                     {"tx_beam", command.tx_beam},
                     {"rx_beam", command.rx_beam},
                     {"object", command.object},
                     {"position", command.position},
                     {"speed", command.speed},
                     {"at_once", command.at_once},
                     {"velocity", command.velocity},
                     {"yaw", command.yaw},
                     {"yaw_rate", command.yaw_rate}});
}

static Value of(const caviar::LinkUser& user) {
  return Value::map({{"tx", user.tx},
                     {"rx", user.rx},
                     {"carrier", user.carrier},
                     {"has_path", user.has_path},
                     {"los", user.los},
                     {"tx_beam", user.tx_beam},
                     {"rx_beam", user.rx_beam},
                     {"best_tx_beam", user.best_tx_beam},
                     {"best_rx_beam", user.best_rx_beam},
                     {"abs_y", user.abs_y},
                     {"snr", user.snr},
                     {"bit_rate", user.bit_rate},
                     {"spectral_efficiency", user.spectral_efficiency}});
}

static Value of(const caviar::Ray& ray) {
  std::vector<Value> a, points;
  for (const auto& gain : ray.a) a.push_back(Value::list({gain.real(), gain.imag()}));
  for (const auto& point : ray.points) points.emplace_back(point);
  return Value::map({{"tx", ray.tx},
                     {"rx", ray.rx},
                     {"a", Value::list(a)},
                     {"tau", ray.tau},
                     {"aod", ray.aod},
                     {"aoa", ray.aoa},
                     {"points", Value::list(points)},
                     {"objects", list(ray.objects)},
                     {"interactions", list(ray.interactions)}});
}

static Value typed(const std::string& topic, const Value& payload) {
  std::vector<Value> found;
  if (topic == "action")
    for (const caviar::Command& command : caviar::commands_of(payload, "pilot")) found.push_back(of(command));
  if (topic == "link")
    for (const caviar::LinkUser& user : caviar::users_of(payload)) found.push_back(of(user));
  if (topic == "channel")
    for (const caviar::Ray& ray : caviar::rays_of(payload)) found.push_back(of(ray));
  return Value::list(found);
}

static Value result(const caviar::Problem& problem) {
  return Value::map({{"code", problem.code}, {"message", problem.message}});
}

static std::string message(const std::vector<std::string>& words) {
  std::vector<Bytes> parts;
  for (std::size_t i = 1; i < words.size(); ++i) parts.push_back(bytes(words[i]));
  caviar::Message found;
  if (caviar::Problem problem = caviar::decode_message(parts, found)) return json(result(problem));
  const Bytes again = caviar::encode(found.type->name.c_str(), found.fields);
  return "{\"header\": " + hex(again) + ", \"value\": " + json(found.fields) + "}";
}

static std::string payload(const std::string& topic, const Bytes& header, const Bytes& body) {
  Value found;
  if (caviar::Problem problem = caviar::decode_payload(topic, header, body, found))
    return json(result(problem));
  for (const auto& [name, type] : caviar::TOPICS) {
    if (topic != name) continue;
    Bytes written;
    const Bytes again = caviar::encode(type, found, &written);
    return "{\"header\": " + hex(again) + ", \"body\": " + hex(written) + ", \"value\": " + json(found) +
           ", \"typed\": " + json(typed(topic, found)) + "}";
  }
  return "null";
}

static std::string arrays(const Bytes& header, const Bytes& body) {
  Value found;
  caviar::Problem problem = caviar::Unpacker(header).read(found);
  caviar::Checker checker(body);
  for (Value& reference : found.items())
    if (!problem) problem = checker.reference(reference);
  if (problem) return json(result(problem));
  Bytes written;
  caviar::Packer packer(&written);
  packer.value(found);
  return "{\"header\": " + hex(packer.out) + ", \"body\": " + hex(written) + ", \"value\": " + json(found) +
         "}";
}

static std::string scene(caviar::Mounts& mounts, const Bytes& header, const Bytes& body, std::string order) {
  Value found;
  if (caviar::Problem problem = caviar::decode_payload("scene", header, body, found))
    return json(result(problem));
  const auto position = found["position"].elements<double>(), size = found["dimensions"].elements<double>();
  const auto velocity = found["velocity"].elements<double>(),
             turned = found["orientation"].elements<double>();
  std::vector<caviar::Object> objects;
  std::stringstream names(order);
  for (std::string name; std::getline(names, name, ',');) {
    for (std::size_t i = 0; i < found["names"].size(); ++i) {
      if (found["names"].at(i).text() != name) continue;
      caviar::Object object;
      object.name = name, object.class_ = found["classes"].at(i).text(),
      object.mesh = found["assets"].at(i).text();
      for (std::size_t k = 0; k < 3; ++k)
        object.position[k] = position[3 * i + k], object.velocity[k] = velocity[3 * i + k],
        object.dimensions[k] = size[3 * i + k];
      for (std::size_t k = 0; k < 4; ++k) object.orientation[k] = turned[4 * i + k];
      objects.push_back(object);
    }
  }
  const std::map<std::string, Value> devices = mounts.devices(objects);
  const auto [again, written] = caviar::encode_scene(objects, devices);
  return "{\"header\": " + hex(again) + ", \"body\": " + hex(written) + "}";
}

static caviar::Axes engine_of(const std::string& name) {
  return name == "unreal"  ? caviar::unreal()
         : name == "unity" ? caviar::unity()
         : name == "godot" ? caviar::godot()
                           : caviar::ned();
}

static std::string engine_mesh(const std::vector<std::string>& words) {
  caviar::Mesh mesh;
  const std::size_t corners = 3 + std::stoul(words[2]);
  const auto number = [&](std::size_t i) { return std::strtod(words[i].c_str(), nullptr); };
  for (std::size_t i = 3; i < corners; i += 3)
    mesh.vertices.push_back({number(i), number(i + 1), number(i + 2)});
  for (std::size_t i = corners; i < words.size(); i += 3)
    mesh.triangles.push_back({std::stoi(words[i]), std::stoi(words[i + 1]), std::stoi(words[i + 2])});
  mesh = engine_of(words[1]).mesh_to_enu(mesh.vertices, mesh.triangles);
  std::vector<Value> vertices, triangles;
  for (const caviar::Vector3& vertex : mesh.vertices) vertices.emplace_back(vertex);
  for (const caviar::Triangle& corners : mesh.triangles)
    triangles.push_back(Value::list({corners[0], corners[1], corners[2]}));
  return json(Value::map({{"vertices", Value::list(vertices)}, {"triangles", Value::list(triangles)}}));
}

static std::string axes(const std::vector<std::string>& words) {
  const caviar::Axes engine = engine_of(words[1]);
  double n[13] = {};
  for (std::size_t i = 0; i < 13; ++i) n[i] = std::strtod(words[3 + i].c_str(), nullptr);
  const caviar::Pose pose{
      {n[0], n[1], n[2]}, {n[3], n[4], n[5], n[6]}, {n[7], n[8], n[9]}, {n[10], n[11], n[12]}};
  const caviar::Pose found = words[2] == "from" ? engine.from_enu(pose) : engine.to_enu(pose);
  return json(Value::map({{"position", found.position},
                          {"orientation", found.orientation},
                          {"velocity", found.velocity},
                          {"angular_velocity", found.angular_velocity},
                          {"sides", engine.dimensions_to_enu({n[0], n[1], n[2]})}}));
}

class Odd : public caviar::World {
 public:
  bool due = false;

  std::vector<caviar::Object> objects() {
    caviar::Object car;
    car.name = car.class_ = "car";
    car.mesh = crate_.mesh, car.dimensions = crate_.dimensions, car.position = crate_.centre;
    const std::string wrong = settings()["wrong"].text();
    if (wrong == "orientation") car.orientation = {2.0, 0.0, 0.0, 0.0};
    if (wrong == "dimensions") car.dimensions[1] = 0.0;
    if (wrong == "position") car.position[2] = std::nan("");
    if (wrong == "velocity") car.velocity[0] = 3e8;
    if (wrong == "unknown mesh") car.mesh = "objects/none.ply";
    if (wrong == "prefix") car.name = "tram";
    if (wrong == "turning") car.angular_velocity = caviar::Vector3{0.0, 0.0, 4e8};
    if (wrong == "no name") car.name = "";
    if (wrong == "class") car.class_ = "";
    if (wrong == "device") car.name = "bs";
    if (wrong == "twice") return {car, car};
    return {car};
  }

 private:
  std::vector<caviar::Input> inputs() override { return {{"action"}, {"link"}, {"channel"}}; }
  void prepare() override {
    claim("car");
    const std::string wrong = settings()["wrong"].text();
    if (wrong == "mesh") offer_mesh("car", {{0, 0, 0}}, {{0, 1, 2}});
    if (wrong == "material")
      offer_scenery({{"ground", "gold", caviar::box_mesh({}, {1, 1, 1})}}, {{"gold", "gold", 1}});
    if (wrong == "name") offer_file("../car.ply", "");
  }
  void spawn_mesh(double t) {
    const std::string spawn = settings()["spawn"].text();
    crate_ = {"", {1.0, 1.0, 1.0}, {}};
    if (spawn.empty() || t < 0.05 || t > 0.35) return;
    caviar::Mesh mesh = caviar::box_mesh({}, {4.0, 2.0, 1.0});
    if (spawn == "nan") mesh.vertices[3][1] = std::nan("");
    if (spawn == "none") mesh.triangles.clear();
    if (spawn == "flat")
      for (caviar::Vector3& vertex : mesh.vertices) vertex[2] = 0.0;
    for (caviar::Vector3& vertex : mesh.vertices) vertex[2] += 0.5;  // its origin is at its bottom
    crate_ = offer_mesh("crate", mesh.vertices, mesh.triangles, spawn == "gold" ? "gold" : "wood");
  }
  std::vector<caviar::Object> step(double t, double previous,
                                   const std::vector<caviar::Command>&) override {
    const std::string how = settings()["how"].text();
    if (how == "fail") fail("it fails");
    if (how == "late") std::this_thread::sleep_for(std::chrono::milliseconds(1500));
    spawn_mesh(t);
    if (!how.empty()) crate_.centre = {t, previous, 0.75};
    for (const caviar::Ray& ray : rays())
      if (ray.a.empty() || !(ray.tau > 0)) fail("a ray has no amplitude");
    for (const caviar::LinkUser& user : link_users())
      if (user.tx.empty() || user.rx.empty()) fail("a user of the link has no name");
    for (const caviar::Product& product : products()) {
      if (product.topic == "channel" && rays().empty()) fail("there is no ray");
      if (product.topic == "link" && link_users().empty()) fail("there is no user of the link");
    }
    if (settings()["deferred"].boolean()) defer(), due = true;
    return objects();
  }

  caviar::OfferedMesh crate_{"", {1.0, 1.0, 1.0}, {}};
};

static int odd_world(const char* endpoint, const char* name) {
  Odd world;
  caviar::leave_on_signals();
  world.connect(endpoint, name);
  while (world.poll(1)) {
    if (world.due) world.due = false, world.publish(world.objects());
  }
  return world.status();
}

int main(int count, char** arguments) {
  if (count == 3) return odd_world(arguments[1], arguments[2]);
  caviar::Mounts mounts;
  for (std::string line; std::getline(std::cin, line);) {
    std::stringstream stream(line);
    std::vector<std::string> words;
    for (std::string word; stream >> word;) words.push_back(word);
    const std::string& what = words[0];
    std::string answer = "null";
    if (what == "message") answer = message(words);
    if (what == "payload") answer = payload(words[1], bytes(words[2]), bytes(words[3]));
    if (what == "arrays") answer = arrays(bytes(words[1]), bytes(words[2]));
    if (what == "scene") answer = scene(mounts, bytes(words[1]), bytes(words[2]), words[3]);
    if (what == "axes") answer = axes(words);
    if (what == "engine_mesh") answer = engine_mesh(words);
    if (what == "match")
      answer = caviar::Pattern::matches(bytes(words[1]), bytes(words[2])) ? "true" : "false";
    if (what == "digest") answer = json(caviar::product_digest(bytes(words[1]), bytes(words[2])));
    if (what == "schema") answer = json(std::string(caviar::TYPES));
    if (what == "mounts") {
      caviar::Message welcome;
      answer = json(result(caviar::decode_message({bytes(words[1])}, welcome)));
      mounts.adopt(welcome.fields["scenario"]["devices"]);
    }
    if (what == "geometry") {
      std::map<std::string, Bytes> files;
      for (std::size_t i = 1; i + 1 < words.size(); i += 2) files[words[i]] = bytes(words[i + 1]);
      answer = json(caviar::geometry_digest(files));
    }
    std::cout << answer << std::endl;
  }
}
