// The reference world: a car and a UAV move, a pedestrian and a ramp come and go, and it brings a street and
// the meshes of car and ramp, that of the ramp while the run goes on. The UAV flies between four points, or
// where agents send it; that state is saved, so that the world goes on where it was when it is killed and
// started again.
//
//     g++ -std=c++17 -O2 world.cpp -o world -lzmq -pthread
//     ./world tcp://127.0.0.1:5555 world
#include "caviar.hpp"

using caviar::Bytes;
using caviar::Command;
using caviar::Object;
using caviar::Vector3;

class Street : public caviar::World {
  struct State {  // doubles alone: no byte of it is padding
    Vector3 position{0.0, -20.0, 20.0}, target{20.0, -20.0, 20.0};
    double speed = 6.0, corners = 0.0;
  } uav_;
  caviar::OfferedMesh car_mesh_;

  void prepare() override {
    for (const char* name : {"car", "pedestrian", "ramp", "uav"}) claim(name);
    caviar::Mesh car = caviar::box_mesh({0.0, 0.0, -0.2}, {1.0, 1.0, 0.6});
    const caviar::Mesh cabin = caviar::box_mesh({-0.05, 0.0, 0.3}, {0.5, 0.9, 0.4});
    for (const caviar::Triangle& corners : cabin.triangles)
      car.triangles.push_back({corners[0] + 8, corners[1] + 8, corners[2] + 8});
    car.vertices.insert(car.vertices.end(), cabin.vertices.begin(), cabin.vertices.end());
    car_mesh_ = offer_mesh("car", car.vertices, car.triangles);
    const caviar::Mesh ground{{{-80, -40, 0}, {80, -40, 0}, {80, 40, 0}, {-80, 40, 0}},
                              {{0, 1, 2}, {0, 2, 3}}};
    offer_scenery(
        {{"ground", "asphalt", ground}, {"house", "brick", caviar::box_mesh({0, 22, 6}, {60, 12, 12})}},
        {{"asphalt", "concrete", 0.2}, {"brick", "brick", 0.3}});
  }

  void reset(std::int64_t, double) override { uav_ = {}; }

  std::vector<Object> step(double t, double previous, const std::vector<Command>& commands) override {
    for (const Command& command : commands)
      if (command.kind == Command::Kind::waypoint && command.object == "uav")
        uav_.target = command.position, uav_.speed = command.speed;
    std::vector<Object> objects{driven(t), flown(t - previous)};
    if (std::fmod(t, 12.0) >= 4.0) objects.push_back(walking(std::fmod(t, 12.0) - 4.0));
    if (std::fmod(t, 12.0) >= 6.0) objects.push_back(standing());
    return objects;
  }

  Object driven(double t) const {  // on a circle of 15 m, counter-clockwise with 9 m/s
    const double rate = 9.0 / 15.0, angle = rate * t;
    Object car{"car", "car", car_mesh_.mesh, {15 * std::cos(angle), 15 * std::sin(angle), 0.75}};
    car.velocity = {-9 * std::sin(angle), 9 * std::cos(angle), 0.0};
    car.orientation = caviar::facing(car.velocity);
    car.dimensions = {4.5, 1.8, 1.5};
    car.angular_velocity = Vector3{0.0, 0.0, rate};
    return car;
  }

  Object flown(double dt) {  // straight to its target, then on to the next corner
    static constexpr double CORNERS[4][2] = {{20, -20}, {20, 10}, {-20, 10}, {-20, -20}};
    Vector3 way{}, velocity{};
    for (std::size_t k = 0; k < 3; ++k) way[k] = uav_.target[k] - uav_.position[k];
    const double left = std::hypot(way[0], way[1], way[2]);
    const double speed = dt > 0 ? std::min(uav_.speed, left / dt) : 0.0;
    for (std::size_t k = 0; k < 3 && left > 0; ++k) velocity[k] = way[k] / left * speed;
    for (std::size_t k = 0; k < 3; ++k) uav_.position[k] += velocity[k] * dt;
    if (left < 1e-6) {
      const double* corner = CORNERS[static_cast<int>(uav_.corners += 1.0) % 4];
      uav_.target = {corner[0], corner[1], 20.0};
    }
    return {"uav", "uav", "", uav_.position, caviar::facing(velocity), velocity, {0.6, 0.6, 0.25}, {}};
  }

  static Object walking(double t) {  // along the pavement, for 8 s
    return {"pedestrian", "pedestrian",    "", {-6.0 + 1.4 * t, 12.0, 0.9}, {1, 0, 0, 0},
            {1.4, 0, 0},  {0.5, 0.6, 1.8}, {}};
  }

  Object standing() {  // offered again in each frame, which costs nothing
    const std::vector<Vector3> wedge{{0, 0, 0}, {2, 0, 0}, {2, 1, 0}, {0, 1, 0}, {0, 0, 1}, {0, 1, 1}};
    const std::vector<caviar::Triangle> sides{{0, 3, 2}, {0, 2, 1}, {0, 1, 4}, {3, 5, 2},
                                              {0, 4, 5}, {0, 5, 3}, {1, 2, 5}, {1, 5, 4}};
    const caviar::OfferedMesh ramp = offer_mesh("ramp", wedge, sides, "wood");
    return {"ramp", "ramp", ramp.mesh, {6.0, 2.0, 1.0}, {1, 0, 0, 0}, {}, {4.0, 2.0, 2.0}, {}};
  }

  Bytes save() override { return Bytes(reinterpret_cast<const char*>(&uav_), sizeof uav_); }
  bool restore(const Bytes& state) override {
    if (state.size() != sizeof uav_) return false;
    return std::memcpy(static_cast<void*>(&uav_), state.data(), sizeof uav_), true;
  }
};

int main(int count, char** words) {
  if (count == 3) return Street().run(words[1], words[2]);
  std::fprintf(stderr, "usage: %s tcp://HOST:PORT NAME\n", words[0]);
  return 2;
}
