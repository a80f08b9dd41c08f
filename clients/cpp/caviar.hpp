// SPDX-License-Identifier: Apache-2.0
//
// caviar.hpp: a simulator or game engine in C++17 becomes a world of a CAVIAR run.
//
//     struct Street : caviar::World {
//       void prepare() override { claim("car"); }
//       std::vector<caviar::Object> step(double t, double, const std::vector<caviar::Command>&) override {
//         caviar::Object car;
//         car.name = car.class_ = "car";
//         car.position = {10.0 * t, 0.0, 0.75};
//         car.velocity = {10.0, 0.0, 0.0};
//         car.dimensions = {4.5, 1.8, 1.5};
//         return {car};
//       }
//     };
//     int main(int, char** argv) { Street street; return street.run(argv[1], argv[2]); }
//
//     g++ -std=c++17 street.cpp -lzmq -pthread
//
// The library speaks the protocol of protocol/SPEC.md: it says HELLO, sends heartbeats from a thread of its
// own, offers and serves scenery, mounts the devices of the scenario on objects, answers each GRANT once and
// repeats the answer when asked again, saves and restores state, refuses what is no message, and comes back
// where its connections were lost. Exceptions and RTTI are not used, so that it compiles in game engines as
// it is; the only library is libzmq. An engine with a loop of its own calls `connect` once and `poll` in
// every tick.
//
// Units and axes: metres, seconds, radians; x east, y north, z up; bodies have x forward, y left, z up;
// quaternions are (w, x, y, z) and take body axes to world axes. `unreal()`, `unity()`, `godot()` and `ned()`
// convert from other axes. Text is UTF-8. The host has to be little-endian.
//
// Contents: 1 bytes and SHA-256 · 2 values and MessagePack · 3 types of messages and payloads · 4 decoding
// and canonical encoding · 5 axes · 6 objects and devices · 7 meshes and scenery · 8 commands, link, channel
// · 9 heartbeats · 10 the world
#ifndef CAVIAR_HPP
#define CAVIAR_HPP

#if defined(_WIN32)  // zmq.h includes windows.h there, whose macros `min` and `max` break the standard
                     // library
#if !defined(NOMINMAX)
#define NOMINMAX
#endif
#if !defined(WIN32_LEAN_AND_MEAN)
#define WIN32_LEAN_AND_MEAN
#endif
#endif
#include <zmq.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <complex>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <initializer_list>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>
#include <thread>
#include <type_traits>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <unistd.h>
#endif

namespace caviar {

using Bytes = std::string;
using Vector3 = std::array<double, 3>;
using Quaternion = std::array<double, 4>;  // (w, x, y, z)

constexpr std::int64_t PROTOCOL_MAJOR = 1, PROTOCOL_MINOR = 6;
constexpr std::size_t MAX_HEADER = 1048576, MAX_BODY = 1073741824, MAX_PARTS = 513, MAX_ASSET_CHUNK = 4194304;
constexpr int MAX_NESTING = 32, MAX_DIMENSIONS = 6;
constexpr double HALF_TURN = 3.14159265358979323846, LIGHT_M_S = 299792458.0;  // [rad], [m/s]

// What is wrong with something: an error code of SPEC.md and a line for people. False where nothing is.
struct Problem {
  std::string code;
  std::string message;
  explicit operator bool() const { return !code.empty(); }
};

inline Problem malformed(std::string message) { return {"malformed", std::move(message)}; }

// --- 1 bytes and SHA-256
// -------------------------------------------------------------------------------------

// FIPS 180-4, over any number of pieces.
class Sha256 {
 public:
  Sha256& add(std::string_view data) {
    length_ += data.size();
    for (const char byte : data) {
      block_[used_++] = static_cast<std::uint8_t>(byte);
      if (used_ == block_.size()) compress();
    }
    return *this;
  }

  // 64 lower-case hexadecimal digits. Ends the digest.
  std::string hex() {
    const std::uint64_t bits = length_ * 8;
    add(std::string_view("\x80", 1));
    while (used_ != 56) add(std::string_view("\0", 1));
    for (int shift = 56; shift >= 0; shift -= 8) block_[used_++] = static_cast<std::uint8_t>(bits >> shift);
    compress();
    std::string text;
    for (const std::uint32_t word : state_)
      for (int shift = 28; shift >= 0; shift -= 4) text += "0123456789abcdef"[(word >> shift) & 15];
    return text;
  }

 private:
  static std::uint32_t turn(std::uint32_t word, int by) { return (word >> by) | (word << (32 - by)); }

  void compress() {
    static constexpr std::uint32_t K[64] = {
        0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
        0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
        0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
        0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
        0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
        0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
        0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
        0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};
    std::uint32_t w[64];
    for (std::size_t i = 0; i < 16; ++i)
      w[i] = static_cast<std::uint32_t>(block_[4 * i]) << 24 |
             static_cast<std::uint32_t>(block_[4 * i + 1]) << 16 |
             static_cast<std::uint32_t>(block_[4 * i + 2]) << 8 |
             static_cast<std::uint32_t>(block_[4 * i + 3]);
    for (std::size_t i = 16; i < 64; ++i)
      w[i] = w[i - 16] + w[i - 7] + (turn(w[i - 15], 7) ^ turn(w[i - 15], 18) ^ (w[i - 15] >> 3)) +
             (turn(w[i - 2], 17) ^ turn(w[i - 2], 19) ^ (w[i - 2] >> 10));
    auto [a, b, c, d, e, f, g, h] = state_;
    for (std::size_t i = 0; i < 64; ++i) {
      const std::uint32_t t1 =
          h + (turn(e, 6) ^ turn(e, 11) ^ turn(e, 25)) + ((e & f) ^ (~e & g)) + K[i] + w[i];
      const std::uint32_t t2 = (turn(a, 2) ^ turn(a, 13) ^ turn(a, 22)) + ((a & b) ^ (a & c) ^ (b & c));
      h = g, g = f, f = e, e = d + t1, d = c, c = b, b = a, a = t1 + t2;
    }
    const std::uint32_t added[8] = {a, b, c, d, e, f, g, h};
    for (std::size_t i = 0; i < 8; ++i) state_[i] += added[i];
    used_ = 0;
  }

  std::array<std::uint32_t, 8> state_{0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
                                      0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
  std::array<std::uint8_t, 64> block_{};
  std::size_t used_ = 0;
  std::uint64_t length_ = 0;
};

inline std::string sha256(std::string_view data) { return Sha256().add(data).hex(); }

// Digest of a product (SPEC.md, Digests).
inline std::string product_digest(const Bytes& header, const Bytes& body) {
  char length[8];
  for (std::size_t i = 0; i < 8; ++i) length[i] = static_cast<char>(header.size() >> (8 * i));
  return Sha256().add(std::string_view(length, 8)).add(header).add(body).hex();
}

// Number of code points of UTF-8 text; none where it is not UTF-8.
inline std::optional<std::size_t> characters(std::string_view text) {
  std::size_t count = 0;
  for (std::size_t i = 0; i < text.size(); ++count) {
    const auto lead = static_cast<std::uint8_t>(text[i++]);
    if (lead < 0x80) continue;
    const int more = lead >= 0xf0 ? 3 : lead >= 0xe0 ? 2 : 1;
    if (lead < 0xc2 || lead > 0xf4) return std::nullopt;
    std::uint32_t point = lead & (0x3f >> more);
    for (int k = 0; k < more; ++k) {
      if (i == text.size() || (text[i] & 0xc0) != 0x80) return std::nullopt;
      point = point << 6 | (text[i++] & 0x3f);
    }
    // Longer forms than necessary, halves of surrogate pairs, and beyond the last code point.
    if ((more == 2 && point < 0x800) || (more == 3 && point < 0x10000) || point > 0x10ffff ||
        (point >= 0xd800 && point < 0xe000))
      return std::nullopt;
  }
  return count;
}

// --- 2 values and MessagePack
// --------------------------------------------------------------------------------

// Element types of arrays, and their sizes [B].
struct ElementType {
  const char* code;
  std::size_t size;
};
inline constexpr ElementType ELEMENT_TYPES[] = {{"|b1", 1}, {"|u1", 1}, {"|i1", 1},  {"<u2", 2},
                                                {"<i4", 4}, {"<i8", 8}, {"<u8", 8},  {"<f4", 4},
                                                {"<f8", 8}, {"<c8", 8}, {"<c16", 16}};

// A plain value: what a header holds. Reading a key that is missing, or another kind, gives nil or the
// fallback.
class Value {
 public:
  enum class Kind : std::uint8_t { none, boolean, integer, number, text, list, map, array };
  struct Entry;

  Value() = default;
  Value(bool value) : kind_(Kind::boolean), integer_(value) {}
  template <typename T, typename = std::enable_if_t<std::is_integral_v<T>>>
  Value(T value) : kind_(Kind::integer), integer_(static_cast<std::int64_t>(value)) {}
  Value(double value) : kind_(Kind::number), number_(value) {}
  Value(const char* value) : kind_(Kind::text), text_(value) {}
  Value(std::string value) : kind_(Kind::text), text_(std::move(value)) {}
  template <std::size_t N>
  Value(const std::array<double, N>& values) : kind_(Kind::list), items_(values.begin(), values.end()) {}

  static Value list(std::vector<Value> items = {}) {
    Value value;
    value.kind_ = Kind::list;
    value.items_ = std::move(items);
    return value;
  }
  static Value map() {
    Value value;
    value.kind_ = Kind::map;
    return value;
  }
  inline static Value map(std::initializer_list<Entry> entries);

  // An array of a product: `data` holds the elements in C order, little-endian.
  static Value array(const char* dtype, const std::vector<std::int64_t>& shape, Bytes data) {
    Value value;
    value.kind_ = Kind::array;
    for (const ElementType& type : ELEMENT_TYPES) {
      if (std::strcmp(type.code, dtype) == 0) value.integer_ = &type - ELEMENT_TYPES;
    }
    for (const std::int64_t size : shape) value.items_.emplace_back(size);
    value.text_ = std::move(data);
    return value;
  }
  // Rows of as many columns, as `<f8` [rows, columns].
  static Value rows(std::size_t columns, const std::vector<double>& numbers) {
    Bytes data(numbers.size() * 8, '\0');
    for (std::size_t i = 0; i < numbers.size(); ++i) {
      const double number = numbers[i] + 0.0;  // −0 and 0 are equal, so their bytes have to be
      std::memcpy(&data[8 * i], &number, 8);
    }
    const auto count = static_cast<std::int64_t>(numbers.size() / columns);
    return array("<f8", {count, static_cast<std::int64_t>(columns)}, std::move(data));
  }

  Kind kind() const { return kind_; }
  bool is(Kind kind) const { return kind_ == kind; }
  bool boolean(bool fallback = false) const { return is(Kind::boolean) ? integer_ != 0 : fallback; }
  std::int64_t integer(std::int64_t fallback = 0) const { return is(Kind::integer) ? integer_ : fallback; }
  double number(double fallback = 0.0) const {
    return is(Kind::number) ? number_ : is(Kind::integer) ? static_cast<double>(integer_) : fallback;
  }
  const std::string& text() const { return is(Kind::text) ? text_ : empty(); }
  std::string text(const char* fallback) const { return is(Kind::text) ? text_ : fallback; }

  // Items of a list; of a map keys and values in turn; sizes of an array.
  const std::vector<Value>& items() const { return items_; }
  std::vector<Value>& items() { return items_; }
  std::size_t size() const { return is(Kind::map) ? items_.size() / 2 : items_.size(); }

  const Value* find(std::string_view key) const {
    for (std::size_t i = 0; is(Kind::map) && i + 1 < items_.size(); i += 2)
      if (items_[i].text_ == key) return &items_[i + 1];
    return nullptr;
  }
  const Value& operator[](std::string_view key) const {
    const Value* found = find(key);
    return found ? *found : nothing();
  }
  const Value& at(std::size_t index) const { return index < items_.size() ? items_[index] : nothing(); }
  Value& set(std::string key, Value value) {
    for (std::size_t i = 0; i + 1 < items_.size(); i += 2)
      if (items_[i].text_ == key) return items_[i + 1] = std::move(value), *this;
    kind_ = Kind::map;
    items_.emplace_back(std::move(key));
    items_.push_back(std::move(value));
    return *this;
  }

  // Of an array.
  const ElementType& element() const { return ELEMENT_TYPES[is(Kind::array) ? integer_ : 0]; }
  const Bytes& data() const { return is(Kind::array) ? text_ : empty(); }
  template <typename T>
  std::vector<T> elements() const {
    std::vector<T> found(data().size() / sizeof(T));
    if (!found.empty()) std::memcpy(found.data(), data().data(), found.size() * sizeof(T));
    return found;
  }

  // Three or four numbers of a list.
  template <std::size_t N>
  std::array<double, N> numbers() const {
    std::array<double, N> found{};
    for (std::size_t i = 0; i < N; ++i) found[i] = at(i).number();
    return found;
  }

  static const Value& nothing() {
    static const Value value;
    return value;
  }

 private:
  static const std::string& empty() {
    static const std::string text;
    return text;
  }

  Kind kind_ = Kind::none;
  std::int64_t integer_ = 0;  // also a boolean, or the index of an array's element type
  double number_ = 0.0;
  std::string text_;  // also the elements of an array
  std::vector<Value> items_;
};

struct Value::Entry {
  const char* key;
  Value value;
};

inline Value Value::map(std::initializer_list<Entry> entries) {
  Value value = map();
  for (const Entry& entry : entries) value.set(entry.key, entry.value);
  return value;
}

// Canonical MessagePack: everything in its shortest form, floats in nine bytes, keys of maps in ascending
// order.
class Packer {
 public:
  explicit Packer(Bytes* body = nullptr) : body_(body) {}

  Bytes out;

  void head(std::uint8_t short_form, std::size_t below, int first,
            std::size_t count) {  // of text, a list or a map
    if (count < below) {
      byte(short_form + count);
    } else if (short_form == 0xa0 && count < 0x100) {
      byte(0xd9), big(count, 1);
    } else if (count < 0x10000) {
      byte(static_cast<std::size_t>(first)), big(count, 2);
    } else {
      byte(static_cast<std::size_t>(first) + 1), big(count, 4);
    }
  }
  void map_head(std::size_t count) { head(0x80, 16, 0xde, count); }
  void list_head(std::size_t count) { head(0x90, 16, 0xdc, count); }
  void text(std::string_view text) {
    head(0xa0, 32, 0xda, text.size());
    out.append(text);
  }
  void boolean(bool value) { byte(value ? 0xc3 : 0xc2); }
  void number(double value) {
    value += 0.0;  // no −0
    std::uint64_t bits = 0;
    std::memcpy(&bits, &value, 8);
    byte(0xcb), big(bits, 8);
  }
  void integer(std::int64_t value) {
    const auto bits = static_cast<std::uint64_t>(value);
    if (value >= -32 && value < 128) {
      byte(bits);
    } else if (value >= 0) {
      const int wide = value < 0x100 ? 0 : value < 0x10000 ? 1 : value < 0x100000000 ? 2 : 3;
      byte(0xcc + static_cast<std::size_t>(wide)), big(bits, 1 << wide);
    } else {
      const int wide = value >= -0x80 ? 0 : value >= -0x8000 ? 1 : value >= -0x80000000LL ? 2 : 3;
      byte(0xd0 + static_cast<std::size_t>(wide)), big(bits, 1 << wide);
    }
  }

  void value(const Value& value) {
    switch (value.kind()) {
      case Value::Kind::none:
        return byte(0xc0);
      case Value::Kind::boolean:
        return boolean(value.boolean());
      case Value::Kind::integer:
        return integer(value.integer());
      case Value::Kind::number:
        return number(value.number());
      case Value::Kind::text:
        return text(value.text());
      case Value::Kind::array:
        return array(value);
      case Value::Kind::list:
        list_head(value.size());
        for (const Value& item : value.items()) this->value(item);
        return;
      case Value::Kind::map:
        return sorted(value);
    }
  }

 private:
  void byte(std::size_t value) { out += static_cast<char>(value & 0xff); }
  void big(std::uint64_t value, int bytes) {
    for (int shift = 8 * (bytes - 1); shift >= 0; shift -= 8) byte(value >> shift);
  }

  void sorted(const Value& value) {
    std::vector<std::size_t> order;
    for (std::size_t i = 0; i < value.items().size(); i += 2) order.push_back(i);
    std::sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) {
      return value.items()[a].text() < value.items()[b].text();
    });
    map_head(order.size());
    for (const std::size_t i : order) text(value.items()[i].text()), this->value(value.items()[i + 1]);
  }

  // A reference in the header; the elements go to the body, at the next multiple of 8.
  void array(const Value& value) {
    Bytes none, &body = body_ ? *body_ : none;
    body.resize((body.size() + 7) / 8 * 8, '\0');
    map_head(3);
    text("dtype"), text(value.element().code);
    text("shape"), list_head(value.items().size());
    for (const Value& size : value.items()) integer(size.integer());
    text("offset"), integer(static_cast<std::int64_t>(body.size()));
    body += value.data();
  }

  Bytes* body_;
};

// Reads one MessagePack value that fills `data`. A length allocates nothing before its bytes are there.
class Unpacker {
 public:
  explicit Unpacker(std::string_view data) : data_(data) {}

  Problem read(Value& out) {
    value(out, 1);
    if (!problem_ && at_ != data_.size()) problem_ = malformed("bytes behind the value");
    return problem_;
  }

 private:
  void fail(const char* message) {
    if (!problem_) problem_ = malformed(message);
  }
  std::size_t left() const { return data_.size() - at_; }
  std::uint64_t big(std::size_t bytes) {
    if (left() < bytes) return fail("it ends too early"), 0;
    std::uint64_t found = 0;
    for (std::size_t i = 0; i < bytes; ++i) found = found << 8 | static_cast<std::uint8_t>(data_[at_++]);
    return found;
  }

  void value(Value& out, int level) {
    const auto head = static_cast<std::uint8_t>(big(1));
    if (problem_) return;
    if (head < 0x80)
      out = Value(static_cast<std::int64_t>(head));
    else if (head < 0x90)
      map(out, head & 15, level);
    else if (head < 0xa0)
      list(out, head & 15, level);
    else if (head < 0xc0)
      text(out, head & 31);
    else if (head >= 0xe0)
      out = Value(static_cast<std::int64_t>(head) - 256);
    else
      switch (head) {
        case 0xc0:
          out = Value();
          break;
        case 0xc2:
        case 0xc3:
          out = Value(head == 0xc3);
          break;
        case 0xca:
        case 0xcb:
          number(out, head == 0xca);
          break;
        case 0xcc:
        case 0xcd:
        case 0xce:
        case 0xcf:
          whole(out, std::size_t{1} << (head - 0xcc));
          break;
        case 0xd0:
        case 0xd1:
        case 0xd2:
        case 0xd3:
          negative(out, std::size_t{1} << (head - 0xd0));
          break;
        case 0xd9:
        case 0xda:
        case 0xdb:
          text(out, big(std::size_t{1} << (head - 0xd9)));
          break;
        case 0xdc:
        case 0xdd:
          list(out, big(head == 0xdc ? 2 : 4), level);
          break;
        case 0xde:
        case 0xdf:
          map(out, big(head == 0xde ? 2 : 4), level);
          break;
        default:
          fail("binary and extension types have no place in a header");
      }
  }

  void whole(Value& out, std::size_t bytes) {
    const std::uint64_t found = big(bytes);
    if (found > static_cast<std::uint64_t>(INT64_MAX)) return fail("an integer exceeds 64 bits with a sign");
    out = Value(static_cast<std::int64_t>(found));
  }
  void negative(Value& out, std::size_t bytes) {
    const std::size_t shift = 64 - 8 * bytes;
    out = Value(static_cast<std::int64_t>(big(bytes) << shift) >> shift);
  }
  void number(Value& out, bool single) {
    double found = 0.0;
    if (single) {
      const auto bits = static_cast<std::uint32_t>(big(4));
      float narrow = 0.0F;
      std::memcpy(&narrow, &bits, 4);
      found = static_cast<double>(narrow);
    } else {
      const std::uint64_t bits = big(8);
      std::memcpy(&found, &bits, 8);
    }
    if (!std::isfinite(found)) return fail("a number is not finite");
    out = Value(found);
  }
  void text(Value& out, std::uint64_t length) {
    if (length > left()) return fail("a text is longer than the bytes that are there");
    const std::string_view found = data_.substr(at_, static_cast<std::size_t>(length));
    if (!characters(found)) return fail("a text is not UTF-8");
    at_ += found.size();
    out = Value(std::string(found));
  }
  bool deeper(int level) {
    if (level > MAX_NESTING && !problem_) problem_ = {"limit", "it nests deeper than 32 maps and lists"};
    return !problem_;
  }
  void list(Value& out, std::uint64_t count, int level) {
    if (!deeper(level)) return;
    if (count > left()) return fail("a list has more items than there are bytes");  // each has one at least
    out = Value::list(std::vector<Value>(static_cast<std::size_t>(count)));
    for (Value& item : out.items()) {
      value(item, level + 1);
      if (problem_) return;
    }
  }
  void map(Value& out, std::uint64_t count, int level) {
    if (!deeper(level)) return;
    if (2 * count > left()) return fail("a map has more entries than there are bytes");
    out = Value::map();
    out.items().resize(static_cast<std::size_t>(2 * count));
    for (std::size_t i = 0; i < out.items().size(); ++i) {
      value(out.items()[i], level + 1);
      if (problem_) return;
      if (i % 2 == 0 && !out.items()[i].is(Value::Kind::text)) return fail("a key is no text");
    }
  }

  std::string_view data_;
  std::size_t at_ = 0;
  Problem problem_;
};

// --- 3 types of messages and payloads
// ------------------------------------------------------------------------

// The tables of SPEC.md, to which a test compares these. A name, `#` and its `type` where it has one; then
// fields in order, as `field:type` and `!` where it is required, `?` where it may be left out, or `=` and its
// default
// (`@`: an object of defaults). Types: `[T]` list, `{T}` map, `T*3` three of them, `A/B` objects by their
// `type`, `a|b` words, `<f8[N,3]` array.
inline constexpr char TYPES[] = R"(
Hello#HELLO version:Version! name:NewName! role:world|channel|sensors|link|agent|recorder|observer!
  inputs:[Input]<=256=[] outputs:[NewName]<=256=[] capabilities:[Word]<=256=[]
  implementation:Text="" max_in_flight:int>=1<=64=1 host:Text="" pid:Count=0
  subscriptions:[Subscription]<=32=[]
Welcome#WELCOME version:Version! run:Text! epoch:Epoch! attempt:Attempt! capabilities:[Word]<=256=[]
  heartbeat_ns:Period! liveness_ns:Period! seed:Seed=0 settings:{plain}={} scenario:{plain}={}
  rejoin_ns:Duration=0
Refuse#REFUSE code:Word! message:Text!
Prepare#PREPARE epoch:Epoch! attempt:Attempt! demand:[Demand]<=256=[] assets:[Asset]=[]
  producers:{[Name]}={} prefixes:{[Text]}={} max_faces:Count=0
Ready#READY epoch:Epoch! attempt:Attempt! geometry:DigestOrNone="" prefixes:[Text]=[]
  actuators:[NamePattern]=[] notes:[Text]=[] seed:SeedOrNone=-1
AssetOffer#ASSET_OFFER epoch:Epoch! attempt:Attempt! assets:[Asset]!
AssetGet#ASSET_GET digest:Digest! offset:Size=0
AssetData#ASSET_DATA digest:Digest! offset:Size! size:Size!
Geometry#GEOMETRY epoch:Epoch! attempt:Attempt! episode:EpisodeIndex! frame:FrameIndex! assets:[Asset]=[]
GeometryDone#GEOMETRY_DONE epoch:Epoch! attempt:Attempt! episode:EpisodeIndex! frame:FrameIndex!
  geometry:DigestOrNone=""
Reset#RESET epoch:Epoch! attempt:Attempt! episode:EpisodeIndex! seed:Seed! t0_ns:Nanoseconds!
  seed_episode:EpisodeIndex=0
ResetDone#RESET_DONE epoch:Epoch! attempt:Attempt! episode:EpisodeIndex!
Grant#GRANT epoch:Epoch! attempt:Attempt! episode:EpisodeIndex! frame:FrameIndex!
  previous_frame:FrameOrNone=-1 t_ns:Nanoseconds! budget_ns:Duration=0 inputs:[GrantInput]<=256=[]
  final:bool=false decisions:{str}={} reports:[Report]<=256=[]
Done#DONE epoch:Epoch! attempt:Attempt! episode:EpisodeIndex! frame:FrameIndex!
  products:[ProductHeader]<=256=[] decisions:{str}={} measured:{Duration}={} counts:{Count}={}
  end_episode:bool=false seed:SeedOrNone=-1 geometry:GeometryChange? geometry_digest:DigestOrNone=""
Fault#FAULT epoch:Epoch! attempt:Attempt! episode:EpisodeIndex=0 frame:FrameOrNone=-1 phase:Text!
  message:Text! detail:Text="" culprit:Text=""
Cancel#CANCEL epoch:Epoch! attempt:Attempt! episode:EpisodeIndex! frame:FrameIndex!
EpisodeEnd#EPISODE_END epoch:Epoch! attempt:Attempt! episode:EpisodeIndex! frames:Count!
Checkpoint#CHECKPOINT epoch:Epoch! attempt:Attempt! episode:EpisodeIndex! frame:FrameIndex!
CheckpointDone#CHECKPOINT_DONE epoch:Epoch! attempt:Attempt! episode:EpisodeIndex! frame:FrameIndex!
Restore#RESTORE epoch:Epoch! attempt:Attempt! episode:EpisodeIndex! frame:FrameIndex!
Shutdown#SHUTDOWN reason:Text! grace_ns:Duration=0
Bye#BYE epoch:Epoch! attempt:Attempt! reason:Text=""
Stale#STALE of:Word! epoch:Epoch! attempt:Attempt! episode:EpisodeIndex! frame:FrameOrNone!
Error#ERROR code:Word! message:Text! of:Text="" subject:Text=""
Observe#OBSERVE sequence:Count! state:Word! paused:bool=false episode:EpisodeIndex=0
  frame:FrameOrNone=-1 t_ns:Nanoseconds=0 inputs:[GrantInput]<=256=[] reports:[Report]<=256=[]
Observed#OBSERVED sequence:Count!
Attach#ATTACH epoch:Epoch! attempt:Attempt! name:Name!
Heartbeat#HEARTBEAT sequence:Count! progress:Count=0 phase:Text="" grace_ns:Duration=0
HeartbeatAck#HEARTBEAT_ACK sequence:Count!
Input topic:NewName! lag:int>=0<=1=0 required:bool=true parts:[Word]<=256=[]
Subscription topic:NewName! source:Text="" every:int>=1=1
Demand topic:Name! parts:[Word]<=256=[]
Asset name:AssetName! digest:Digest! size:Size!
GeometryChange frame:FrameIndex! assets:[Asset]=[]
GrantInput topic:Name! source:Name! status:fresh|held|absent|late! frame:FrameOrNone=-1
  t_ns:Nanoseconds=0 age:Age=0 fidelity:Text="" digest:DigestOrNone="" cause:Text=""
  geometry:DigestOrNone=""
Report source:Name! decisions:{str}={} measured:{Duration}={} counts:{Count}={} geometry:GeometryChange?
ProductHeader topic:Name! digest:Digest! fidelity:Text=""
Scene names:[str]! classes:[str]! assets:[str]! position:<f8[N,3]! orientation:<f8[N,4]!
  velocity:<f8[N,3]! dimensions:<f8[N,3]! devices:[AntennaDevice/LidarDevice/CameraDevice]=[]
  angular_velocity:<f8[N,3]?
AntennaDevice#antenna name:str! parent:str="" position:Vector3=[0.0,0.0,0.0]
  orientation:Quaternion=[1.0,0.0,0.0,0.0] role:tx|rx|both! array:AntennaArray=@ power_dbm:float=0.0
  carriers:[str]=[]
LidarDevice#lidar name:str! parent:str="" position:Vector3=[0.0,0.0,0.0]
  orientation:Quaternion=[1.0,0.0,0.0,0.0] beams:int>=1<=1024=64 azimuth_steps:int>=1<=36000=1800
  elevation_min:float=-0.4363323129985824 elevation_max:float=0.05235987755982989
  max_range:float>0=100.0 min_range:float>=0=0.0
CameraDevice#camera name:str! parent:str="" position:Vector3=[0.0,0.0,0.0]
  orientation:Quaternion=[1.0,0.0,0.0,0.0] width:int>=1<=8192=640 height:int>=1<=8192=480
  field_of_view:float>0=1.5707963267948966
AntennaArray rows:int>=1<=1024=1 columns:int>=1<=1024=1 vertical_spacing:float>0=0.5
  horizontal_spacing:float>0=0.5 pattern:iso|dipole|hw_dipole|tr38901="iso"
  polarization:V|H|-45|+45|RHCP|LHCP|VH|cross|circular="V" pattern_file:str="" panels:[Panel]=[]
  codebook:str="dft"
Panel position_m:Vector3=[0.0,0.0,0.0] yaw_deg:float=0.0 pitch_deg:float=0.0 roll_deg:float=0.0
Channel rung:str! options:ChannelOptions=@ expected_error_db:float? carriers:[Carrier]! tx:[str]!
  rx:[str]! los:|b1[T,R]! offsets:<i8[L1]! object_names:[str]=[] id:<u8[P]! a:<c16[C,P]! tau:<f8[P]!
  aod:<f8[P,2]! aoa:<f8[P,2]! doppler:<f8[C,P]! interactions:|u1[P,D]! points:<f8[P,D,3]!
  objects:<i4[P,D]! h:[ChannelMatrix]=[] dropped:int>=0=0 hf:[ChannelResponse]=[]
  taps:[ChannelTaps]=[] error_bound_db:<f8[T,R]? error_reference:str=""
  used:|b1[C,T,R]?
Carrier name:str! frequency_hz:float>0! bandwidth_hz:float>0=100000000.0 subcarriers:int>=0<=65536=0
  subcarrier_spacing_hz:float>=0=0.0 taps:int>=0<=65536=0 slots:int>=1<=65536=1
  slot_duration_s:float>=0=0.0
ChannelOptions los:bool=true reflection:bool=false refraction:bool=false diffraction:bool=false
  scattering:bool=false max_depth:int>=0=0 samples:int>=0=0 materials_outside:[str]=[]
  absorption_db_per_km:[float>=0]=[] detail:str="" foliage:[str]=[] blockage:[str]=[]
ChannelMatrix carrier:int>=0! tx:int>=0! rx:int>=0! h:<c16[Nr,Nt]!
ChannelResponse carrier:int>=0! tx:int>=0! rx:int>=0! h:<c8[S,K,Nr,Nt]!
ChannelTaps carrier:int>=0! tx:int>=0! rx:int>=0! first:int! h:<c8[S,L,Nr,Nt]!
Lidar object_names:[str]! scans:[LidarScan]!
LidarScan sensor:str! position:Vector3! orientation:Quaternion! ray:<i4[N]! points:<f4[N,3]!
  points_world:<f4[N,3]? range:<f4[N]! object:<i4[N]! grid:OccupancyGrid?
OccupancyGrid origin:Vector3! cell:Vector3! occupancy:|i1[X,Y,Z]!
Camera images:[CameraImage]!
CameraImage sensor:str! intrinsics:Intrinsics! position:Vector3! orientation:Quaternion!
  rgb:|u1[H,W,3]!
Depth images:[DepthImage]!
DepthImage sensor:str! intrinsics:Intrinsics! position:Vector3! orientation:Quaternion!
  depth:<f4[H,W]! normals:<f4[H,W,3]?
Segmentation object_names:[str]! material_names:[str]=[] images:[SegmentationImage]!
SegmentationImage sensor:str! intrinsics:Intrinsics! position:Vector3! orientation:Quaternion!
  object:<i4[H,W]! material:<i4[H,W]?
Intrinsics fx:float! fy:float! cx:float! cy:float!
Action commands:[BeamChoice/WaypointCommand/VelocityCommand/UserSchedule/PathCommand/AttitudeCommand/DriveCommand/SignalCommand]!
BeamChoice#beam tx:str! rx:str! tx_beam:int>=0! rx_beam:int>=0=0 carrier:str=""
WaypointCommand#waypoint object:str! position:Vector3! speed:float>0! at_once:bool=false yaw:float?
VelocityCommand#velocity object:str! velocity:float*3! yaw:float? yaw_rate:float?
PathCommand#path object:str! points:[Vector3]! speed:float>0!
AttitudeCommand#attitude object:str! orientation:Quaternion! thrust:float>=0!
DriveCommand#drive object:str! speed:float>=0? lane:int>=0? route:[str]=[] stop:RoadStop?
RoadStop road:str! position:float>=0! duration:float>=0! lane:int>=0=0
SignalCommand#signal signal:str! phase:int>=0! duration:float>0?
UserSchedule#schedule tx:str! rx:str!
Link tx:[str]! rx:[str]! carrier:[str]! has_path:|b1[U]! los:|b1[U]! tx_beam:<i4[U]! rx_beam:<i4[U]!
  abs_y:<f8[U]! top_tx_beam:<i4[U,K]! top_rx_beam:<i4[U,K]! top_abs_y:<f8[U,K]!
  baseline_abs_y:<f8[U]! aod_azimuth:<f8[U]! aoa_azimuth:<f8[U]! snr:<f8[U]! snr_best:<f8[U]!
  spectral_efficiency:<f8[U]! bit_rate:<f8[U]! reward:<f8[U]! buffered:<f8[U]? no_path:int>=0=0
  serving:|b1[U]? arrived:<i8[U]? sent:<i8[U]? dropped:<i8[U]? delivered:<i8[U]? delay:<f8[U]?
  waiting:<f8[U]? sinr:<f8[U]? throughput:<f8[U]? blocks:<i8[U]? block_errors:<i8[U]?
)";

// Topic of a product and the type of its payload.
inline constexpr std::pair<const char*, const char*> TOPICS[] = {
    {"scene", "Scene"}, {"channel", "Channel"},           {"lidar", "Lidar"},   {"camera", "Camera"},
    {"depth", "Depth"}, {"segmentation", "Segmentation"}, {"action", "Action"}, {"link", "Link"}};

// Type of a field.
struct Type {
  enum class Kind : std::uint8_t { plain, boolean, integer, number, text, word, list, map, object, array };
  Kind kind = Kind::plain;
  std::string name;  // of a text: the rule it has to keep; of an array: its element type
  std::int64_t least = INT64_MIN, most = INT64_MAX;  // of an integer
  double above = -HUGE_VAL, from = -HUGE_VAL;        // of a number: greater than, at least
  std::vector<std::string> words;                    // that may stand there; objects; sizes of an array
  std::vector<Type> inner;                           // of a list or map
  std::size_t exactly = 0, at_most = SIZE_MAX;       // items of a list
};

struct Field {
  std::string name;
  Type type;
  bool required = false;
  std::optional<Bytes> standard;  // its default as MessagePack
};

struct ObjectType {
  std::string name;
  std::string tag;  // `type` of its map; empty: it has none
  std::vector<Field> fields;
};

// Reads TYPES once.
class TypeTable {
 public:
  static const TypeTable& get() {
    static const TypeTable table;
    return table;
  }

  const ObjectType* named(std::string_view name) const {
    for (const ObjectType& object : objects_)
      if (object.name == name) return &object;
    return nullptr;
  }
  const ObjectType* tagged(std::string_view tag) const {
    for (const ObjectType& object : objects_)
      if (!object.tag.empty() && object.tag == tag) return &object;
    return nullptr;
  }

 private:
  TypeTable() {
    std::string_view text = TYPES;
    while (!text.empty()) {
      const std::size_t end = std::min(text.find_first_of(" \n"), text.size());
      const std::string_view word = text.substr(0, end);
      text.remove_prefix(std::min(end + 1, text.size()));
      if (word.empty()) continue;
      const std::size_t colon = word.find(':');
      if (colon == std::string_view::npos) {
        const std::size_t mark = std::min(word.find('#'), word.size());
        const std::string_view tag = word.substr(std::min(mark + 1, word.size()));
        objects_.push_back({std::string(word.substr(0, mark)), std::string(tag), {}});
      } else {
        objects_.back().fields.push_back(field(word.substr(0, colon), word.substr(colon + 1)));
      }
    }
  }

  static Field field(std::string_view name, std::string_view rest) {
    Field found;
    found.name = name;
    found.required = rest.back() == '!';
    if (found.required || rest.back() == '?') {
      found.type = type(rest.substr(0, rest.size() - 1));
      return found;
    }
    std::size_t equal = rest.rfind('=');
    // The sign of a bound, as in `>=1`, begins no default.
    while (equal != std::string_view::npos && equal > 0 && (rest[equal - 1] == '<' || rest[equal - 1] == '>'))
      equal = rest.rfind('=', equal - 1);
    found.type = type(rest.substr(0, equal));
    found.standard = standard(found.type, std::string(rest.substr(equal + 1)));
    return found;
  }

  static Type type(std::string_view text) {
    Type found;
    if (text[0] == '[' || text[0] == '{') {
      const std::size_t close = text.rfind(text[0] == '[' ? ']' : '}');
      found.kind = text[0] == '[' ? Type::Kind::list : Type::Kind::map;
      found.inner = {type(text.substr(1, close - 1))};
      if (close + 1 < text.size()) found.at_most = std::strtoull(text.data() + close + 3, nullptr, 10);
    } else if (text[0] == '<' || (text[0] == '|' && text.find('[') != std::string_view::npos)) {
      const std::size_t open = text.find('[');
      found.kind = Type::Kind::array;
      found.name = text.substr(0, open);
      found.words = split(text.substr(open + 1, text.size() - open - 2), ',');
    } else if (text.find('|') != std::string_view::npos) {
      found.kind = Type::Kind::word;
      found.words = split(text, '|');
    } else {
      simple(found, text);
    }
    return found;
  }

  static void simple(Type& found, std::string_view text) {
    static constexpr std::pair<const char*, std::int64_t> INTEGERS[] = {
        {"Epoch", 1},  {"Attempt", 1}, {"EpisodeIndex", 0}, {"FrameIndex", 0},          {"FrameOrNone", -1},
        {"Age", 0},    {"Seed", 0},    {"SeedOrNone", -1},  {"Nanoseconds", INT64_MIN}, {"Duration", 0},
        {"Period", 1}, {"Count", 0},   {"Size", 0}};
    static constexpr const char* TEXTS[] = {"str",  "Text",        "Name",   "NewName",     "AssetName",
                                            "Word", "NamePattern", "Digest", "DigestOrNone"};
    const std::string word(text);
    found.name = word;
    for (const auto& [name, least] : INTEGERS)
      if (word == name) found.kind = Type::Kind::integer, found.least = least;
    for (const char* name : TEXTS)
      if (word == name) found.kind = Type::Kind::text;
    if (word == "bool") found.kind = Type::Kind::boolean;
    if (word == "Version")
      several(found, "int>=0", 2);
    else if (word == "Vector3" || word == "float*3")
      several(found, "float", 3);
    else if (word == "Quaternion")
      several(found, "float", 4);
    else if (word.rfind("int", 0) == 0 || word.rfind("float", 0) == 0)
      bounded(found, word);
    else if (found.kind == Type::Kind::plain && word != "plain") {
      found.kind = Type::Kind::object;
      found.words = split(text, '/');
    }
  }

  static void several(Type& found, const char* inner, std::size_t count) {
    found.kind = Type::Kind::list;
    found.inner = {type(inner)};
    found.exactly = count;
  }

  static void bounded(Type& found, const std::string& word) {
    found.kind = word[0] == 'i' ? Type::Kind::integer : Type::Kind::number;
    for (std::size_t i = word.find_first_of("<>"); i < word.size(); i = word.find_first_of("<>", i + 1)) {
      const bool equal = word[i + 1] == '=';
      const long long bound = std::strtoll(word.c_str() + i + 1 + equal, nullptr, 10);
      if (word[i] == '<')
        found.most = bound;
      else if (equal)
        found.least = bound, found.from = static_cast<double>(bound);
      else
        found.above = static_cast<double>(bound);
    }
  }

  static std::vector<std::string> split(std::string_view text, char by) {
    std::vector<std::string> found;
    for (std::size_t from = 0, to = 0; to < text.size(); from = to + 1) {
      to = std::min(text.find(by, from), text.size());
      found.emplace_back(text.substr(from, to - from));
    }
    return found;
  }

  static Bytes standard(const Type& type, std::string text) {
    Packer packer;
    text.erase(std::remove(text.begin(), text.end(), '"'), text.end());
    if (type.kind == Type::Kind::boolean)
      packer.boolean(text == "true");
    else if (type.kind == Type::Kind::integer)
      packer.integer(std::strtoll(text.c_str(), nullptr, 10));
    else if (type.kind == Type::Kind::number)
      packer.number(decimal(text));
    else if (type.kind == Type::Kind::text || type.kind == Type::Kind::word)
      packer.text(text);
    else if (type.kind == Type::Kind::map || text == "@")
      packer.map_head(0);
    else if (text == "[]")
      packer.list_head(0);
    else {
      const std::vector<std::string> numbers = split(std::string_view(text).substr(1, text.size() - 2), ',');
      packer.list_head(numbers.size());
      for (const std::string& number : numbers) packer.number(decimal(number));
    }
    return packer.out;
  }

  // `strtod` reads a decimal point or comma as the locale says, which an engine may set.
  static double decimal(std::string text) {
    char one[8];
    std::snprintf(one, sizeof one, "%.1f", 1.5);
    for (char& digit : text)
      if (digit == '.') digit = one[1];
    return std::strtod(text.c_str(), nullptr);
  }

  std::vector<ObjectType> objects_;
};

// --- 4 decoding and canonical encoding
// -----------------------------------------------------------------------

// Rules for the text of a field, by the name of its type.
inline bool keeps_rule(const std::string& rule, std::string_view text) {
  if (rule == "str" || rule == "Text") return true;
  if (rule == "Digest" || rule == "DigestOrNone")
    return (text.empty() && rule == "DigestOrNone") ||
           (text.size() == 64 && text.find_first_not_of("0123456789abcdef") == std::string_view::npos);
  const std::size_t most = rule == "AssetName" || rule == "NamePattern" ? 255 : 128;
  const std::size_t count = characters(text).value_or(0);
  if (count < 1 || count > most) return false;
  if (rule != "NewName" && rule != "AssetName") return true;
  for (const char character : text)
    if (static_cast<std::uint8_t>(character) < 0x20 || character == 0x7f) return false;
  if (rule == "NewName") return true;
  if (text.find('\\') != std::string_view::npos) return false;
  for (std::size_t from = 0, to = 0; from <= text.size(); from = to + 1) {
    to = std::min(text.find('/', from), text.size());
    const std::string_view segment = text.substr(from, to - from);
    if (segment.empty() || segment == "." || segment == "..") return false;
  }
  return true;
}

// Checks a value that was read against its type. Objects keep the fields that are known, in the order of
// their table; integers where floats belong become floats; references become arrays with their elements.
class Checker {
 public:
  explicit Checker(std::string_view body) : body_(body) {}

  Problem object(const ObjectType& type, Value& value) {
    if (!value.is(Value::Kind::map)) return malformed(": a map is expected");
    std::vector<Value> kept(type.fields.size() + 1);
    std::vector<bool> there(kept.size());
    Sizes outer;
    std::swap(outer, sizes_);
    Problem problem;
    // In the order of the bytes, since arrays follow each other in the order of their references.
    for (std::size_t i = 0; i < value.items().size() && !problem; i += 2) {
      const std::string& key = value.items()[i].text();
      for (std::size_t k = 0; k < type.fields.size() && !problem; ++k) {
        if (type.fields[k].name != key) continue;
        problem = conform(type.fields[k].type, value.items()[i + 1]);
        if (problem) problem.message.insert(0, "." + key);
        kept[k] = std::move(value.items()[i + 1]);
        there[k] = true;
      }
    }
    Value found = Value::map();
    if (!type.tag.empty()) found.items() = {Value("type"), Value(type.tag)};
    for (std::size_t k = 0; k < type.fields.size() && !problem; ++k) {
      if (!there[k] && type.fields[k].required)
        problem = malformed("." + type.fields[k].name + ": it is missing");
      if (!there[k]) continue;
      found.items().emplace_back(type.fields[k].name);
      found.items().push_back(std::move(kept[k]));
    }
    if (!problem) problem = lengths(type.name, found);
    std::swap(outer, sizes_);
    value = std::move(found);
    return problem;
  }

  Problem conform(const Type& type, Value& value) {
    switch (type.kind) {
      case Type::Kind::plain:
        return {};
      case Type::Kind::boolean:
        return value.is(Value::Kind::boolean) ? Problem{} : malformed(": true or false is expected");
      case Type::Kind::integer:
        if (!value.is(Value::Kind::integer)) return malformed(": an integer is expected");
        if (value.integer() >= type.least && value.integer() <= type.most) return {};
        return malformed(": " + std::to_string(value.integer()) + " is out of its range");
      case Type::Kind::number:
        if (!value.is(Value::Kind::number) && !value.is(Value::Kind::integer))
          return malformed(": a number is expected");
        value = Value(value.number());
        if (value.number() > type.above && value.number() >= type.from) return {};
        return malformed(": " + std::to_string(value.number()) + " is out of its range");
      case Type::Kind::text:
        if (value.is(Value::Kind::text) && keeps_rule(type.name, value.text())) return {};
        return malformed(": a text is expected that is a " + type.name);
      case Type::Kind::word:
        return word(type, value);
      case Type::Kind::list:
        return list(type, value);
      case Type::Kind::map:
        return map(type, value);
      case Type::Kind::object:
        return one_of(type, value);
      case Type::Kind::array:
        return array(type, value);
    }
    return {};
  }

  // Turn a reference into an array with its elements, whatever its type.
  Problem reference(Value& value) {
    const Value &dtype = value["dtype"], &shape = value["shape"], &offset = value["offset"];
    const ElementType* element = nullptr;
    for (const ElementType& known : ELEMENT_TYPES)
      if (dtype.text() == known.code) element = &known;
    if (!element) return malformed(": '" + dtype.text() + "' is no element type");
    if (!shape.is(Value::Kind::list)) return malformed(": an array needs a shape");
    if (shape.size() > MAX_DIMENSIONS) return {"limit", ": an array has six dimensions at most"};
    std::uint64_t count = 1;
    std::vector<std::int64_t> sizes;
    for (const Value& size : shape.items()) {
      if (size.integer(-1) < 0) return malformed(": a size of an array is no natural number");
      sizes.push_back(size.integer());
      // One more than fits is enough to be refused, and never overflows.
      const auto factor = static_cast<std::uint64_t>(size.integer());
      count = factor && count > MAX_BODY / factor ? MAX_BODY + 1 : count * factor;
    }
    if (std::find(sizes.begin(), sizes.end(), 0) != sizes.end()) count = 0;
    const std::uint64_t bytes = count * element->size, begin = static_cast<std::uint64_t>(offset.integer(-1));
    if (offset.integer(-1) < 0 || begin % 8) return malformed(": an offset is no multiple of 8");
    if (begin < taken_) return malformed(": an array begins before the end of the one before");
    if (begin > body_.size() || bytes > body_.size() - begin)
      return malformed(": an array ends past the body");
    taken_ = begin + bytes;
    Bytes data(body_.substr(static_cast<std::size_t>(begin), static_cast<std::size_t>(bytes)));
    value = Value::array(element->code, sizes, std::move(data));
    return elements(value);
  }

 private:
  using Sizes = std::vector<std::pair<std::string, std::int64_t>>;

  static Problem elements(const Value& value) {
    const std::string code = value.element().code;
    if (code == "|b1")
      for (const char flag : value.data())
        if (flag != 0 && flag != 1) return malformed(": a flag is neither 0 nor 1");
    bool finite = true;
    if (code == "<f8" || code == "<c16")
      for (const double number : value.elements<double>()) finite = finite && std::isfinite(number);
    if (code == "<f4" || code == "<c8")
      for (const float number : value.elements<float>()) finite = finite && std::isfinite(number);
    return finite ? Problem{} : malformed(": a number is not finite");
  }

  static Problem word(const Type& type, const Value& value) {
    for (const std::string& known : type.words)
      if (value.is(Value::Kind::text) && value.text() == known) return {};
    return malformed(": '" + value.text() + "' is none of its words");
  }

  Problem list(const Type& type, Value& value) {
    if (!value.is(Value::Kind::list)) return malformed(": a list is expected");
    if (type.exactly && value.size() != type.exactly)
      return malformed(": " + std::to_string(type.exactly) + " items are expected");
    if (value.size() > type.at_most)
      return malformed(": " + std::to_string(value.size()) + " items are too many");
    for (std::size_t i = 0; i < value.size(); ++i) {
      if (Problem problem = conform(type.inner[0], value.items()[i])) {
        problem.message.insert(0, "[" + std::to_string(i) + "]");
        return problem;
      }
    }
    return {};
  }

  Problem map(const Type& type, Value& value) {
    if (!value.is(Value::Kind::map)) return malformed(": a map is expected");
    for (std::size_t i = 0; i < value.items().size(); i += 2) {
      if (Problem problem = conform(type.inner[0], value.items()[i + 1])) {
        problem.message.insert(0, "." + value.items()[i].text());
        return problem;
      }
    }
    return {};
  }

  Problem one_of(const Type& type, Value& value) {
    const std::string tag = value["type"].text();
    for (const std::string& name : type.words) {
      const ObjectType& found = *TypeTable::get().named(name);
      if (found.tag.empty() || found.tag == tag) return object(found, value);
    }
    return malformed(".type: '" + tag + "' is none of its kinds");
  }

  Problem array(const Type& type, Value& value) {
    if (!value.is(Value::Kind::map)) return malformed(": a reference to an array is expected");
    if (Problem problem = reference(value)) return problem;
    if (value.element().code != type.name) return malformed(": elements have to be " + type.name);
    if (value.size() != type.words.size())
      return malformed(": " + std::to_string(type.words.size()) + " dimensions are expected");
    for (std::size_t i = 0; i < value.size(); ++i)
      if (!agrees(type.words[i], value.items()[i].integer()))
        return malformed(": the size " + type.words[i] + " of its shape differs from others");
    return {};
  }

  // A size is a number, or a name that stands for one size throughout an object.
  bool agrees(const std::string& name, std::int64_t size) {
    if (name[0] >= '0' && name[0] <= '9') return std::strtoll(name.c_str(), nullptr, 10) == size;
    for (const auto& [known, value] : sizes_)
      if (known == name) return value == size;
    sizes_.emplace_back(name, size);
    return true;
  }

  // What prose says of the lengths of lists, and of path offsets.
  Problem lengths(const std::string& object, const Value& value) {
    static constexpr const char* LISTS[][3] = {
        {"Scene", "names", "N"},      {"Scene", "classes", "N"}, {"Scene", "assets", "N"},
        {"Link", "tx", "U"},          {"Link", "rx", "U"},       {"Link", "carrier", "U"},
        {"Channel", "carriers", "C"}, {"Channel", "tx", "T"},    {"Channel", "rx", "R"}};
    for (const auto& [name, list, size] : LISTS)
      if (object == name && !agrees(size, static_cast<std::int64_t>(value[list].size())))
        return malformed(std::string(".") + list + ": its length is not " + size);
    if (object != "Channel") return {};
    const std::vector<std::int64_t> offsets = value["offsets"].elements<std::int64_t>();
    const std::size_t pairs = value["tx"].size() * value["rx"].size();
    const bool right = offsets.size() == pairs + 1 && offsets.front() == 0 &&
                       std::is_sorted(offsets.begin(), offsets.end()) &&
                       offsets.back() == value["tau"].at(0).integer();
    return right ? Problem{} : malformed(".offsets: they do not divide the paths among the pairs");
  }

  std::string_view body_;
  std::uint64_t taken_ = 0;
  Sizes sizes_;
};

// Writes an object in canonical form: fields in order, those that equal their default left out.
class Encoder {
 public:
  explicit Encoder(Bytes* body = nullptr) : body_(body) {}

  Bytes object(const ObjectType& type, const Value& value) {
    std::size_t count = 0;
    Packer fields(body_);
    if (!type.tag.empty()) ++count, fields.text("type"), fields.text(type.tag);
    for (const Field& field : type.fields) {
      const Value* found = value.find(field.name);
      if (!found) continue;
      const Bytes written = encoded(field.type, *found);
      if (field.standard && *field.standard == written) continue;
      ++count, fields.text(field.name), fields.out += written;
    }
    Packer whole;
    whole.map_head(count);
    return whole.out + fields.out;
  }

 private:
  Bytes encoded(const Type& type, const Value& value) {
    Packer packer(body_);
    if (type.kind == Type::Kind::number) {
      packer.number(value.number());
    } else if (type.kind == Type::Kind::list) {
      packer.list_head(value.size());
      for (const Value& item : value.items()) packer.out += encoded(type.inner[0], item);
    } else if (type.kind == Type::Kind::object) {
      for (const std::string& name : type.words) {
        const ObjectType& found = *TypeTable::get().named(name);
        if (found.tag.empty() || found.tag == value["type"].text()) return object(found, value);
      }
    } else {
      packer.value(value);
    }
    return packer.out;
  }

  Bytes* body_;
};

// Header of a message or payload, by the name of its type in TYPES; its arrays go to `body`.
inline Bytes encode(const char* type, const Value& fields, Bytes* body = nullptr) {
  return Encoder(body).object(*TypeTable::get().named(type), fields);
}

inline Problem decode_payload(const std::string& topic, const Bytes& header, const Bytes& body, Value& out) {
  const ObjectType* type = nullptr;
  for (const auto& [name, object] : TOPICS)
    if (topic == name) type = TypeTable::get().named(object);
  if (!type) return malformed("'" + topic + "' is no topic");
  if (header.size() > MAX_HEADER) return {"limit", topic + ": its header is larger than 1 MiB"};
  if (body.size() > MAX_BODY) return {"limit", topic + ": its body is larger than 1 GiB"};
  Problem problem = Unpacker(header).read(out);
  if (!problem) problem = Checker(body).object(*type, out);
  if (problem) problem.message.insert(0, topic + (problem.message[0] == '.' ? "" : ": "));
  return problem;
}

struct Message {
  const ObjectType* type = nullptr;
  Value fields;
  std::vector<Bytes> parts;  // behind the header
  bool is(const char* tag) const { return type && type->tag == tag; }
};

// The parts that a message has to have, and their sizes.
inline Problem check_parts(const Message& message) {
  std::size_t due = 0;
  const bool inputs = message.is("GRANT") || message.is("OBSERVE");
  const bool products = inputs || message.is("DONE"), asset = message.is("ASSET_DATA");
  if (message.is("DONE")) due = 2 * message.fields["products"].size();
  for (const Value& input : message.fields["inputs"].items())
    if (inputs && input["status"].text() != "absent") due += 2;
  if (asset || message.is("RESTORE") || message.is("CHECKPOINT_DONE")) due = 1;
  if (message.parts.size() != due)
    return malformed(message.type->tag + " announces " + std::to_string(due) + " parts behind its header, " +
                     std::to_string(message.parts.size()) + " came");
  for (std::size_t i = 0; i < due; ++i) {
    const std::size_t most = asset ? MAX_ASSET_CHUNK : products && i % 2 == 0 ? MAX_HEADER : MAX_BODY;
    if (message.parts[i].size() > most) return {"limit", message.type->tag + " has a part that is too large"};
  }
  if (asset && message.fields["offset"].integer() >
                   message.fields["size"].integer() - static_cast<std::int64_t>(message.parts[0].size()))
    return malformed("ASSET_DATA reaches beyond the size that it states");
  return {};
}

inline Problem decode_message(std::vector<Bytes> parts, Message& out) {
  if (parts.empty() || parts[0].empty()) return malformed("the first part of a message is its header");
  if (parts[0].size() > MAX_HEADER) return {"limit", "the header of a message is larger than 1 MiB"};
  if (Problem problem = Unpacker(parts[0]).read(out.fields)) return problem;
  if (!out.fields.is(Value::Kind::map)) return malformed("the header of a message is a map");
  const std::string tag = out.fields["type"].text();
  out.type = TypeTable::get().tagged(tag);
  if (!out.type || tag.find_first_of("abcdefghijklmnopqrstuvwxyz") != std::string::npos)
    return malformed("'" + tag + "' is no type of a message");
  const Value& major = out.fields["version"].at(0);  // can be read in every major version
  if ((tag == "HELLO" || tag == "WELCOME") && major.is(Value::Kind::integer) &&
      major.integer() != PROTOCOL_MAJOR)
    return {"version", "the peer speaks version " + std::to_string(major.integer()) +
                           " of the protocol, this " + "client version " + std::to_string(PROTOCOL_MAJOR)};
  Problem problem = Checker({}).object(*out.type, out.fields);
  if (problem) return problem.message.insert(0, tag), problem;
  parts.erase(parts.begin());
  out.parts = std::move(parts);
  return check_parts(out);
}

// --- 5 axes
// --------------------------------------------------------------------------------------------------

inline Quaternion multiply(const Quaternion& a, const Quaternion& b) {
  return {a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
          a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
          a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
          a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0]};
}

inline Quaternion conjugate(const Quaternion& q) { return {q[0], -q[1], -q[2], -q[3]}; }

// Yaw about z, then pitch about the new y (positive lowers the nose), then roll about the new x [rad].
inline Quaternion from_euler(double yaw, double pitch, double roll) {
  const double cy = std::cos(yaw / 2), sy = std::sin(yaw / 2), cp = std::cos(pitch / 2),
               sp = std::sin(pitch / 2);
  const double cr = std::cos(roll / 2), sr = std::sin(roll / 2);
  return {cy * cp * cr + sy * sp * sr, cy * cp * sr - sy * sp * cr, cy * sp * cr + sy * cp * sr,
          sy * cp * cr - cy * sp * sr};
}

// Faces along a velocity's horizontal course; a body that stands faces east.
inline Quaternion facing(const Vector3& velocity) {
  return from_euler(std::atan2(velocity[1], velocity[0]), 0, 0);
}

inline double radians(double degrees) { return degrees * (HALF_TURN / 180.0); }

struct Pose {
  Vector3 position{};
  Quaternion orientation{1.0, 0.0, 0.0, 0.0};
  Vector3 velocity{};
  Vector3 angular_velocity{};
};

using Triangle = std::array<std::int32_t, 3>;  // corners, counter-clockwise seen from outside

struct Mesh {
  std::vector<Vector3> vertices;  // [m]
  std::vector<Triangle> triangles;
};

// Axes and unit of length of an engine. Row i of `world` says which ENU axis (1 x, 2 y, 3 z, with its sign)
// the engine's axis i is, `body` the same of forward, left, up; `unit` is the length in the engine of 1 m;
// `clockwise`: how the engine has the corners of its triangles, as seen from outside.
struct Axes {
  std::array<int, 3> world, body;
  double unit;
  bool clockwise = false;

  Pose from_enu(const Pose& pose) const {
    return {scaled(unit, to(world, pose.position)), turned(world, body, pose.orientation),
            scaled(unit, to(world, pose.velocity)), scaled(hand(world), to(world, pose.angular_velocity))};
  }
  Pose to_enu(const Pose& pose) const {
    const std::array<int, 3> from_world = inverse(world), from_body = inverse(body);
    return {scaled(1 / unit, to(from_world, pose.position)), turned(from_world, from_body, pose.orientation),
            scaled(1 / unit, to(from_world, pose.velocity)),
            scaled(hand(world), to(from_world, pose.angular_velocity))};
  }
  // Sides of a box: ENU's length, width and height of the engine's.
  Vector3 dimensions_to_enu(const Vector3& sides) const {
    Vector3 found = scaled(1 / unit, to(inverse(body), sides));
    for (double& side : found) side = std::fabs(side);
    return found;
  }
  // A mesh for `offer_mesh`, forward, left, up [m] and counter-clockwise as seen from outside, of one in the
  // engine's body axes, unit and winding: clockwise in Unity and Godot, where the second and third corner
  // change places; counter-clockwise in Unreal.
  Mesh mesh_to_enu(const std::vector<Vector3>& vertices, const std::vector<Triangle>& triangles) const {
    Mesh mesh{vertices, triangles};
    for (Vector3& vertex : mesh.vertices) vertex = scaled(1 / unit, to(inverse(body), vertex));
    for (Triangle& corners : mesh.triangles)
      if (clockwise) std::swap(corners[1], corners[2]);
    return mesh;
  }

 private:
  static std::size_t axis(int signed_axis) { return static_cast<std::size_t>(std::abs(signed_axis) - 1); }
  static Vector3 to(const std::array<int, 3>& rows, const Vector3& v) {
    Vector3 found{};
    for (std::size_t i = 0; i < 3; ++i) found[i] = (rows[i] < 0 ? -1.0 : 1.0) * v[axis(rows[i])] + 0.0;
    return found;
  }
  static Vector3 scaled(double factor, Vector3 v) {
    for (double& component : v) component = component * factor + 0.0;
    return v;
  }
  static std::array<int, 3> inverse(const std::array<int, 3>& rows) {
    std::array<int, 3> found{};
    for (int i = 0; i < 3; ++i) {
      const int row = rows[static_cast<std::size_t>(i)];
      found[axis(row)] = row < 0 ? -(i + 1) : i + 1;
    }
    return found;
  }
  // Determinant: −1 where the axes are of the other hand.
  static double hand(const std::array<int, 3>& rows) {
    const std::size_t a = axis(rows[0]), b = axis(rows[1]);
    const bool even = (a + 1) % 3 == b, negative = (rows[0] < 0) != ((rows[1] < 0) != (rows[2] < 0));
    return even != negative ? 1.0 : -1.0;
  }
  // W·R·Bᵀ = (W·Bᵀ)·(B·R·Bᵀ): the second factor turns about B's image of the axis, the first is fixed.
  static Quaternion turned(const std::array<int, 3>& world, const std::array<int, 3>& body,
                           const Quaternion& q) {
    const Vector3 v = scaled(hand(body), to(body, {q[1], q[2], q[3]}));
    const Quaternion found = multiply(between(world, inverse(body)), {q[0], v[0], v[1], v[2]});
    const double sign = found[0] < 0 ? -1.0 : 1.0;
    return {sign * found[0], sign * found[1], sign * found[2], sign * found[3]};
  }
  // Quaternion of the rotation matrix W·Bᵀ.
  static Quaternion between(const std::array<int, 3>& world, const std::array<int, 3>& back) {
    double m[3][3] = {};
    for (std::size_t i = 0; i < 3; ++i) {
      Vector3 unit_vector{};
      unit_vector[i] = 1.0;
      const Vector3 column = to(world, to(back, unit_vector));
      for (std::size_t k = 0; k < 3; ++k) m[k][i] = column[k];
    }
    const auto root = [](double value) { return std::sqrt(std::max(0.0, 1.0 + value)) / 2; };
    const auto with_sign = [](double size, double sign) { return sign < 0 ? -size : size; };
    return {root(m[0][0] + m[1][1] + m[2][2]),
            with_sign(root(m[0][0] - m[1][1] - m[2][2]), m[2][1] - m[1][2]),
            with_sign(root(m[1][1] - m[0][0] - m[2][2]), m[0][2] - m[2][0]),
            with_sign(root(m[2][2] - m[0][0] - m[1][1]), m[1][0] - m[0][1])};
  }
};

inline Axes unreal() { return {{1, -2, 3}, {1, -2, 3}, 100.0}; }       // left-handed, cm: forward, right, up
inline Axes unity() { return {{-2, 3, 1}, {-2, 3, 1}, 1.0, true}; }    // left-handed, m: right, up, forward
inline Axes godot() { return {{-2, 3, -1}, {-2, 3, -1}, 1.0, true}; }  // right-handed, m: right, up, back
inline Axes ned() { return {{2, 1, -3}, {1, -2, -3}, 1.0}; }           // right-handed, m: north, east, down

// --- 6 objects and devices
// -----------------------------------------------------------------------------------

// One object at one instant.
struct Object {
  std::string name;    // begins with what `claim` declared; unique among objects and devices
  std::string class_;  // car, truck, bus, uav, pedestrian, …
  std::string mesh;    // that `offer_mesh` returned; empty: a box
  Vector3 position{};  // centre of the bounding box [m]
  Quaternion orientation{1.0, 0.0, 0.0, 0.0};  // body to world
  Vector3 velocity{};                          // world axes [m/s]
  Vector3 dimensions{1.0, 1.0, 1.0};           // length, width, height [m]
  std::optional<Vector3>
      angular_velocity{};  // world axes [rad/s]; none: it does not turn, or is not known to
};

// Name, or pattern with `*`, `?`, `[abc]`, `[a-z]`, `[!abc]`, as `on` of a device has it.
class Pattern {
 public:
  static bool matches(std::string_view pattern, std::string_view text) {
    return pattern == text || Pattern{points(pattern), points(text)}.from(0, 0);
  }

 private:
  using Points = std::u32string;
  Pattern(Points pattern, Points text) : pattern_(std::move(pattern)), text_(std::move(text)) {}

  static Points points(std::string_view text) {
    Points found;
    for (const char byte : text) {
      const auto unit = static_cast<std::uint8_t>(byte);
      if ((unit & 0xc0) != 0x80)
        found += unit < 0x80 ? unit : unit & (unit >= 0xf0 ? 7 : unit >= 0xe0 ? 15 : 31);
      else if (!found.empty())
        found.back() = found.back() << 6 | (unit & 0x3f);
    }
    return found;
  }

  // Greedy, with the last `*` to go back to: never more than the product of both lengths.
  bool from(std::size_t p, std::size_t t) const {
    std::size_t star = Points::npos, resume = 0;
    while (t < text_.size()) {
      std::size_t next = p;
      if (p < pattern_.size() && pattern_[p] == U'*') {
        star = p++, resume = t;
      } else if (p < pattern_.size() && one(next, text_[t])) {
        p = next, ++t;
      } else if (star != Points::npos) {
        p = star + 1, t = ++resume;
      } else {
        return false;
      }
    }
    while (p < pattern_.size() && pattern_[p] == U'*') ++p;
    return p == pattern_.size();
  }

  // Whether what stands at `p` matches a character; `p` is then what comes after it.
  bool one(std::size_t& p, char32_t character) const {
    const char32_t first = pattern_[p++];
    const std::size_t negated = first == U'[' && p < pattern_.size() && pattern_[p] == U'!';
    const std::size_t close = first == U'[' ? pattern_.find(U']', p + negated + 1) : Points::npos;
    if (close == Points::npos) return first == U'?' || first == character;
    bool found = false;
    for (std::size_t i = p + negated; i < close; ++i) {
      const bool range = i + 2 < close && pattern_[i + 1] == U'-';
      const char32_t last = range ? pattern_[i + 2] : pattern_[i];
      found = found || (pattern_[i] <= character && character <= last);
      if (range) i += 2;
    }
    p = close + 1;
    return found != (negated == 1);
  }

  Points pattern_, text_;
};

// Mounts the devices of WELCOME (SPEC.md, «Which devices»).
class Mounts {
 public:
  void adopt(const Value& devices) {
    specs_ = devices.items();
    arrived_.clear();
  }

  // Objects of the last frame, those that came first in front: the state that outlives a frame.
  std::vector<std::string> arrived() const { return arrived_; }
  void clear(std::vector<std::string> arrived = {}) { arrived_ = std::move(arrived); }

  std::vector<std::string> fixed_names() const {
    std::vector<std::string> names;
    for (const Value& spec : specs_)
      if (spec["on"].text().empty()) names.push_back(spec["name"].text());
    return names;
  }

  // Devices of a frame, by name. Objects that were not in the frame before come in the order of the list.
  std::map<std::string, Value> devices(const std::vector<Object>& objects) {
    std::map<std::string, const Object*> there;
    for (const Object& object : objects) there[object.name] = &object;
    std::vector<std::string> arrived;
    for (const std::string& name : arrived_)
      if (there.count(name)) arrived.push_back(name);
    std::map<std::string, bool> known;
    for (const std::string& name : arrived) known[name] = true;
    for (const Object& object : objects)
      if (!known.count(object.name)) arrived.push_back(object.name);
    arrived_ = std::move(arrived);
    std::map<std::string, Value> found;
    for (const Value& spec : specs_) {
      if (spec["on"].text().empty()) found[spec["name"].text()] = device(spec, nullptr);
      std::int64_t left = spec["on"].text().empty() ? 0 : spec["count"].integer(1);
      for (std::size_t i = 0; i < arrived_.size() && left > 0; ++i) {
        if (!Pattern::matches(spec["on"].text(), arrived_[i])) continue;
        found[arrived_[i] + "/" + spec["name"].text()] = device(spec, there[arrived_[i]]);
        --left;
      }
    }
    return found;
  }

 private:
  static Value device(const Value& spec, const Object* parent) {
    const std::string kind = spec["kind"].text(), name = spec["name"].text(), mount = spec["mount"].text();
    Vector3 position = spec["position_m"].numbers<3>();
    Quaternion turned = from_euler(radians(spec["yaw_deg"].number()), radians(spec["pitch_deg"].number()),
                                   radians(spec["roll_deg"].number()));
    if (parent) {
      position[2] += (mount == "roof" ? 0.5 : mount == "floor" ? -0.5 : 0.0) * parent->dimensions[2];
      if (spec["keeps_heading"].boolean()) turned = multiply(conjugate(parent->orientation), turned);
    }
    // Fields that equal their defaults are left out by the encoder.
    Value found = Value::map({{"type", kind},
                              {"name", parent ? parent->name + "/" + name : name},
                              {"parent", parent ? parent->name : ""},
                              {"position", position},
                              {"orientation", turned}});
    const auto angle = [&](const char* key, std::size_t index) {
      return radians(spec[key].at(index).number());
    };
    if (kind == "antenna") {
      found.set("role", spec["role"]).set("array", array(spec["array"])).set("power_dbm", spec["power_dbm"]);
      const Value& carriers = spec["carriers"];  // nil from a broker of an earlier version
      found.set("carriers", carriers.kind() == Value::Kind::list ? carriers : Value::list());
    } else if (kind == "lidar") {
      found.set("beams", spec["beams"]).set("azimuth_steps", spec["azimuth_steps"]);
      found.set("elevation_min", angle("elevation_deg", 0)).set("elevation_max", angle("elevation_deg", 1));
      found.set("min_range", spec["range_m"].at(0)).set("max_range", spec["range_m"].at(1));
    } else {
      found.set("width", spec["size_px"].at(0)).set("height", spec["size_px"].at(1));
      found.set("field_of_view", radians(spec["field_of_view_deg"].number()));
    }
    return found;
  }

  // A path on the broker's machine becomes the name of an asset.
  static Value array(Value spec) {
    if (!spec.is(Value::Kind::map)) return Value::map();
    const std::string path = spec["pattern_file"].text();
    if (!path.empty()) spec.set("pattern_file", "patterns/" + path.substr(path.rfind('/') + 1));
    return spec;
  }

  std::vector<Value> specs_;
  std::vector<std::string> arrived_;
};

// Whether a name is that of a mesh that came while a run went on, `objects/SHA-256.ply`: consumers without
// that mesh have a box.
inline bool is_mesh_name(const std::string& name) {
  return name.size() == 8 + 64 + 4 && name.rfind("objects/", 0) == 0 && name.rfind(".ply") == 72 &&
         name.find_first_not_of("0123456789abcdef", 8) == 72;
}

// What is wrong with the objects of a frame; nothing where consumers will accept them (SPEC.md, Content).
inline std::string wrong_object(const Object& object, const std::vector<std::string>& prefixes,
                                const std::map<std::string, Bytes>& files) {
  // Not `hypot` of three: that of libstdc++ 12 ignores a NaN.
  const auto length = [](const Vector3& v) { return std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); };
  const auto shown = [](const auto& row) {
    std::string text;
    char number[32];
    for (const double value : row) {
      std::snprintf(number, sizeof number, "%.12g", value);
      text += (text.empty() ? "(" : ", ") + std::string(number);
    }
    return text + ")";
  };
  const Quaternion& q = object.orientation;
  const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  const std::string who = "object '" + object.name + "': ";
  const auto begins = [&](const std::string& prefix) { return object.name.rfind(prefix, 0) == 0; };
  if (!keeps_rule("NewName", object.name))
    return who + "name is '" + object.name + "'; give it 1 to 128 printable characters";
  if (std::none_of(prefixes.begin(), prefixes.end(), begins)) {
    std::string known;
    for (const std::string& prefix : prefixes) known += (known.empty() ? "'" : ", '") + prefix + "'";
    return who + "name begins with no prefix (" + known + "); call claim() for it in prepare()";
  }
  if (!keeps_rule("NewName", object.class_))
    return who + "class_ is '" + object.class_ + "'; give it 1 to 128 printable characters: car, uav, …";
  if (!object.mesh.empty() && !files.count(object.mesh) && !is_mesh_name(object.mesh))
    return who + "mesh is '" + object.mesh + "', which was not offered; offer_mesh() returns its name";
  if (!(std::fabs(norm - 1.0) <= 1e-3))
    return who + "orientation is " + shown(q) + "; give it a unit quaternion (w, x, y, z)";
  for (const double coordinate : object.position)
    if (!(std::fabs(coordinate) <= 1e9))
      return who + "position is " + shown(object.position) + "; give it finite numbers of at most 1e9 m";
  const double speed = length(object.velocity);
  if (!(speed < LIGHT_M_S))
    return who + "velocity is " + shown(object.velocity) + "; give it finite numbers, slower than light";
  for (const double side : object.dimensions)
    if (!(side > 0.0 && side <= 1e5))
      return who + "dimensions are " + shown(object.dimensions) + "; give it sides above 0, at most 1e5 m";
  const Vector3 turning = object.angular_velocity.value_or(Vector3{});
  if (!(speed + length(turning) * length(object.dimensions) / 2 < LIGHT_M_S))
    return who + "angular_velocity is " + shown(turning) +
           "; give it finite numbers [rad/s] with which the corners are slower than light";
  return {};
}

// Header and body of a scene: objects sorted by name, with the devices of the frame.
inline std::pair<Bytes, Bytes> encode_scene(std::vector<Object> objects,
                                            const std::map<std::string, Value>& devices) {
  std::sort(objects.begin(), objects.end(), [](const Object& a, const Object& b) { return a.name < b.name; });
  std::vector<Value> names, classes, assets, mounted;
  std::vector<double> position, orientation, velocity, dimensions, turning;
  bool turns = false;
  const auto add = [](std::vector<double>& to, const auto& v) { to.insert(to.end(), v.begin(), v.end()); };
  for (const Object& object : objects) {
    names.emplace_back(object.name), classes.emplace_back(object.class_), assets.emplace_back(object.mesh);
    add(position, object.position), add(orientation, object.orientation), add(velocity, object.velocity);
    add(dimensions, object.dimensions), add(turning, object.angular_velocity.value_or(Vector3{}));
    turns = turns || object.angular_velocity.has_value();
  }
  for (const auto& entry : devices) mounted.push_back(entry.second);
  Value scene = Value::map({{"names", Value::list(names)},
                            {"classes", Value::list(classes)},
                            {"assets", Value::list(assets)},
                            {"position", Value::rows(3, position)},
                            {"orientation", Value::rows(4, orientation)},
                            {"velocity", Value::rows(3, velocity)},
                            {"dimensions", Value::rows(3, dimensions)},
                            {"devices", Value::list(mounted)}});
  if (turns) scene.set("angular_velocity", Value::rows(3, turning));
  std::pair<Bytes, Bytes> product;
  product.first = encode("Scene", scene, &product.second);
  return product;
}

// --- 7 meshes and scenery
// ------------------------------------------------------------------------------------

// A part of the static scenery.
struct Surface {
  std::string name;      // letters, digits, `_`, `-`, `.`; how products name it
  std::string material;  // one of those that are given beside it
  Mesh mesh;             // world axes
};

struct Material {
  std::string name;
  std::string type;  // of Recommendation ITU-R P.2040: concrete, brick, glass, metal, …
  double thickness_m = 0.1;
};

struct Box {
  Vector3 centre{}, size{};
};

// Box around the vertices that are finite; all 0 where there is none.
inline Box bounds(const std::vector<Vector3>& vertices) {
  std::optional<Vector3> least, most;
  for (const Vector3& v : vertices) {
    if (!std::isfinite(v[0]) || !std::isfinite(v[1]) || !std::isfinite(v[2])) continue;
    if (!least) least = most = v;
    for (std::size_t k = 0; k < 3; ++k)
      (*least)[k] = std::min((*least)[k], v[k]), (*most)[k] = std::max((*most)[k], v[k]);
  }
  Box box;
  for (std::size_t k = 0; k < 3 && least; ++k)
    box.centre[k] = ((*least)[k] + (*most)[k]) / 2, box.size[k] = (*most)[k] - (*least)[k];
  return box;
}

// A mesh that `offer_mesh` took, as objects have it.
struct OfferedMesh {
  std::string mesh;      // for `mesh` of objects; empty where it was refused, and they are boxes
  Vector3 dimensions{};  // of its bounding box [m]
  Vector3 centre{};      // of that box in the axes of the mesh [m]: where `position` of objects is
};

// An axis-aligned box as a mesh of twelve triangles.
inline Mesh box_mesh(const Vector3& centre, const Vector3& size) {
  Mesh mesh;
  for (int i = 0; i < 8; ++i)
    mesh.vertices.push_back({centre[0] + ((i & 1) ? 0.5 : -0.5) * size[0],
                             centre[1] + ((i & 2) ? 0.5 : -0.5) * size[1],
                             centre[2] + ((i & 4) ? 0.5 : -0.5) * size[2]});
  mesh.triangles = {{0, 2, 3}, {0, 3, 1}, {4, 5, 7}, {4, 7, 6}, {0, 1, 5}, {0, 5, 4},
                    {2, 6, 7}, {2, 7, 3}, {0, 4, 6}, {0, 6, 2}, {1, 3, 7}, {1, 7, 5}};
  return mesh;
}

// What is wrong with a mesh; nothing where it is one.
inline std::string wrong_mesh(const Mesh& mesh) {
  const auto count = static_cast<std::int64_t>(mesh.vertices.size());
  for (const Vector3& vertex : mesh.vertices)
    for (const double coordinate : vertex)
      if (!std::isfinite(static_cast<float>(coordinate))) return "a vertex is not finite";
  for (const Triangle& triangle : mesh.triangles)
    for (const std::int32_t corner : triangle)
      if (corner < 0 || corner >= count)
        return "corner " + std::to_string(corner) + " is none of its vertices";
  return mesh.triangles.empty() ? "it has no triangle" : "";
}

// The mesh as a binary PLY file, which names the material of its object, where it has one of its own.
inline Bytes to_ply(const Mesh& mesh, const std::string& material = "") {
  const std::string comment = material.empty() ? "" : "comment material " + material + "\n";
  Bytes file = "ply\nformat binary_little_endian 1.0\n" + comment + "element vertex " +
               std::to_string(mesh.vertices.size()) +
               "\nproperty float x\nproperty float y\nproperty float z\nelement face " +
               std::to_string(mesh.triangles.size()) +
               "\nproperty list uchar int vertex_indices\nend_header\n";
  const auto add = [&file](const void* data, std::size_t size) {
    file.append(static_cast<const char*>(data), size);
  };
  for (const Vector3& vertex : mesh.vertices) {
    for (const double coordinate : vertex) {
      const auto narrow = static_cast<float>(coordinate + 0.0);
      add(&narrow, sizeof narrow);
    }
  }
  for (const Triangle& triangle : mesh.triangles) file += '\3', add(triangle.data(), sizeof triangle);
  return file;
}

// The description of the scene: a material for each, a shape for each surface.
inline Bytes to_scene_xml(const std::vector<Surface>& surfaces, const std::vector<Material>& materials) {
  Bytes xml = "<scene version=\"2.1.0\">\n";
  for (const Material& material : materials) {
    char thickness[32];
    std::snprintf(thickness, sizeof thickness, "%.9g", material.thickness_m);
    std::replace(thickness, thickness + std::strlen(thickness), ',', '.');  // of a locale
    xml += "  <bsdf type=\"itu-radio-material\" id=\"mat-" + material.name +
           "\">\n    <string name=\"type\" value=\"" + material.type +
           "\"/>\n    <float name=\"thickness\" value=\"" + thickness + "\"/>\n  </bsdf>\n";
  }
  for (const Surface& surface : surfaces)
    xml += "  <shape type=\"ply\" id=\"mesh-" + surface.name +
           "\">\n    <string name=\"filename\" value=\"meshes/" + surface.name +
           ".ply\"/>\n    <boolean name=\"face_normals\" value=\"true\"/>\n    <ref id=\"mat-" +
           surface.material + "\" name=\"bsdf\"/>\n  </shape>\n";
  return xml + "</scene>\n";
}

// Whether a name can stand in the scene's description and in a path.
inline bool plain_name(const std::string& name) {
  static constexpr char LETTERS[] = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-.";
  return !name.empty() && name[0] != '.' && name.rfind("mesh-", 0) != 0 &&
         name.find_first_not_of(LETTERS) == std::string::npos;
}

// What is wrong with a material of Recommendation ITU-R P.2040; nothing where there is one of this name.
inline std::string wrong_material(const std::string& type) {
  static constexpr char TYPES_OF_P2040[] =
      " asphalt_concrete brick carpet_tile ceiling_board chipboard clear_acrylic concrete floorboard glass "
      "marble "
      "metal plasterboard plywood vinyl_tile wood very_dry_ground medium_dry_ground wet_ground vacuum ";
  if (std::strstr(TYPES_OF_P2040, (" " + type + " ").c_str()) != nullptr) return {};
  return "'" + type + "' is none of" + TYPES_OF_P2040;
}

// What is wrong with scenery; nothing where it can be offered.
inline std::string wrong_scenery(const std::vector<Surface>& surfaces,
                                 const std::vector<Material>& materials) {
  std::map<std::string, bool> names, kinds;
  for (const Material& material : materials) {
    if (!plain_name(material.name) || kinds.count(material.name))
      return "material '" + material.name + "': names are unique, of letters, digits, '_', '-' and '.'";
    if (const std::string wrong = wrong_material(material.type); !wrong.empty())
      return "material '" + material.name + "': " + wrong;
    if (!(material.thickness_m > 0))
      return "material '" + material.name + "': its thickness is not above 0 m";
    kinds[material.name] = true;
  }
  for (const Surface& surface : surfaces) {
    if (!plain_name(surface.name) || names.count(surface.name))
      return "surface '" + surface.name + "': names are unique, of letters, digits, '_', '-' and '.'";
    if (!kinds.count(surface.material))
      return "surface '" + surface.name + "': there is no material '" + surface.material + "'";
    if (const std::string wrong = wrong_mesh(surface.mesh); !wrong.empty())
      return "surface '" + surface.name + "': " + wrong;
    names[surface.name] = true;
  }
  return {};
}

// Digest of all files, by name in ascending order (SPEC.md, Digests); empty without any.
inline std::string geometry_digest(const std::map<std::string, Bytes>& files) {
  Sha256 digest;
  for (const auto& [name, data] : files) {
    digest.add(name).add(std::string_view("\0", 1));
    digest.add(sha256(data)).add(std::string_view("\0", 1));
  }
  return files.empty() ? "" : digest.hex();
}

// Meshes that come while an episode goes on, each for as long as an object has it (SPEC.md, Geometry at run
// time).
class RunTimeMeshes {
 public:
  static constexpr std::int64_t LINGER_FRAMES = 20;  // one that comes back soon costs nothing

  std::int64_t max_faces = 0;  // triangles that a mesh may have; 0: the run takes none, and objects are boxes

  // Begins an episode, or goes on in it at a frame. `again`: another process may have announced some before.
  void reset(bool again, std::int64_t frame = 0) {
    files_.clear(), used_.clear(), announced_.clear();
    frame_ = frame, known_ = !again;
  }

  // The name of the mesh of a file.
  std::string add(Bytes file) {
    const std::string name = "objects/" + sha256(file) + ".ply";
    std::int64_t& used = used_.emplace(name, frame_).first->second;
    used = std::max(used, frame_);
    files_.emplace(name, std::move(file));
    return name;
  }

  bool has(const std::string& name) const { return files_.count(name) && !refused_.count(name); }

  // What DONE says of the meshes of a frame: nothing where they are those of the frame before.
  std::optional<Value> change(std::int64_t frame, const std::vector<Object>& objects) {
    frame_ = frame + 1;
    if (max_faces == 0) return {};
    for (const Object& object : objects)
      if (const auto used = used_.find(object.mesh); used != used_.end()) used->second = frame;
    for (auto used = used_.begin(); used != used_.end();) {
      const bool gone = used->second + LINGER_FRAMES < frame;
      if (gone) files_.erase(used->first);
      used = gone ? used_.erase(used) : std::next(used);
    }
    std::vector<std::string> names;
    for (const auto& entry : files_)
      if (has(entry.first)) names.push_back(entry.first);
    if (known_ && names == announced_) return {};
    known_ = true, announced_ = names;
    std::vector<Value> assets;
    for (const std::string& name : names)
      assets.push_back(
          Value::map({{"name", name}, {"digest", name.substr(8, 64)}, {"size", files_[name].size()}}));
    return Value::map({{"frame", frame}, {"assets", Value::list(assets)}});
  }

  // The broker takes a mesh for none, or, where the digest is empty, all that were announced.
  void refuse(const std::string& digest) {
    for (const auto& entry : files_)
      if (digest.empty() || entry.first.substr(8, 64) == digest) refused_[entry.first] = true;
  }

  // The file of a digest; null where there is none.
  const Bytes* find(const std::string& digest) const {
    const auto found = files_.find("objects/" + digest + ".ply");
    return found == files_.end() ? nullptr : &found->second;
  }

 private:
  std::map<std::string, Bytes> files_;
  std::map<std::string, std::int64_t> used_;  // frame in which an object had it last, or in which it came
  std::map<std::string, bool> refused_;
  std::vector<std::string> announced_;
  std::int64_t frame_ = 0;  // that is computed next
  bool known_ = true;       // whether `announced_` is what the broker has
};

// --- 8 commands, link, channel
// -------------------------------------------------------------------------------

// One command of an agent's action.
struct Command {
  enum class Kind : std::uint8_t { beam, waypoint, velocity, schedule, other };
  Kind kind = Kind::beam;
  std::string source;           // the agent
  std::string tx, rx, carrier;  // beam, schedule
  std::int64_t tx_beam = 0, rx_beam = 0;
  std::string object;    // waypoint, velocity
  Vector3 position{};    // waypoint [m]
  double speed = 0.0;    // at most [m/s]
  bool at_once = false;  // be there in this frame, at rest
  Vector3 velocity{};    // [m/s]
  Value yaw, yaw_rate;   // waypoint, velocity [rad, rad/s]; none: along the course
  Value fields;          // all of them, and those of other kinds: path, attitude, drive, signal
};

inline std::vector<Command> commands_of(const Value& action, const std::string& source) {
  std::vector<Command> found;
  for (const Value& value : action["commands"].items()) {
    Command command;
    const std::string type = value["type"].text();
    command.kind = type == "beam"       ? Command::Kind::beam
                   : type == "waypoint" ? Command::Kind::waypoint
                   : type == "velocity" ? Command::Kind::velocity
                   : type == "schedule" ? Command::Kind::schedule
                                        : Command::Kind::other;
    command.fields = value;
    command.source = source;
    command.tx = value["tx"].text(), command.rx = value["rx"].text(),
    command.carrier = value["carrier"].text();
    command.tx_beam = value["tx_beam"].integer(), command.rx_beam = value["rx_beam"].integer();
    command.object = value["object"].text(), command.position = value["position"].numbers<3>();
    command.speed = value["speed"].number(), command.at_once = value["at_once"].boolean();
    command.velocity = value["velocity"].numbers<3>();
    command.yaw = value["yaw"], command.yaw_rate = value["yaw_rate"];
    found.push_back(std::move(command));
  }
  return found;
}

// What a link says of one pair of devices on one carrier.
struct LinkUser {
  std::string tx, rx, carrier;
  bool has_path = false, los = false;
  std::int32_t tx_beam = -1, rx_beam = -1;  // chosen; −1: none
  std::int32_t best_tx_beam = -1, best_rx_beam = -1;
  double abs_y = 0.0, snr = 0.0, spectral_efficiency = 0.0, bit_rate = 0.0;  // linear, bit/s/Hz, bit/s
};

inline std::vector<LinkUser> users_of(const Value& link) {
  const auto tx = link["tx_beam"].elements<std::int32_t>(), rx = link["rx_beam"].elements<std::int32_t>();
  const auto top_tx = link["top_tx_beam"].elements<std::int32_t>();
  const auto top_rx = link["top_rx_beam"].elements<std::int32_t>();
  const auto abs_y = link["abs_y"].elements<double>(), snr = link["snr"].elements<double>();
  const auto efficiency = link["spectral_efficiency"].elements<double>();
  const auto rate = link["bit_rate"].elements<double>();
  const Bytes &path = link["has_path"].data(), &los = link["los"].data();
  const std::size_t pairs = tx.empty() ? 0 : top_tx.size() / tx.size();
  std::vector<LinkUser> found(tx.size());
  for (std::size_t i = 0; i < found.size(); ++i) {
    LinkUser& user = found[i];
    user.tx = link["tx"].at(i).text(), user.rx = link["rx"].at(i).text();
    user.carrier = link["carrier"].at(i).text();
    user.has_path = path[i] != 0, user.los = los[i] != 0;
    user.tx_beam = tx[i], user.rx_beam = rx[i];
    if (pairs) user.best_tx_beam = top_tx[i * pairs], user.best_rx_beam = top_rx[i * pairs];
    user.abs_y = abs_y[i], user.snr = snr[i], user.spectral_efficiency = efficiency[i],
    user.bit_rate = rate[i];
  }
  return found;
}

// One path of a channel, as a line to draw and a number for each carrier.
struct Ray {
  std::string tx, rx;
  std::vector<std::complex<double>> a;     // amplitude gain, for each carrier
  double tau = 0.0;                        // delay [s]
  std::array<double, 2> aod{}, aoa{};      // zenith, azimuth [rad]
  std::vector<Vector3> points;             // where it interacts, TX to RX [m]
  std::vector<std::uint8_t> interactions;  // 1 reflection, 2 diffraction, 3 scattering, 4 transmission
  std::vector<std::string> objects;        // what it meets there; empty where that is not known
};

inline std::vector<Ray> rays_of(const Value& channel) {
  const auto offsets = channel["offsets"].elements<std::int64_t>();
  const auto a = channel["a"].elements<std::complex<double>>();
  const auto tau = channel["tau"].elements<double>(), points = channel["points"].elements<double>();
  const auto aod = channel["aod"].elements<double>(), aoa = channel["aoa"].elements<double>();
  const auto kinds = channel["interactions"].elements<std::uint8_t>();
  const auto objects = channel["objects"].elements<std::int32_t>();
  const std::size_t receivers = channel["rx"].size(), paths = tau.size(),
                    carriers = channel["carriers"].size();
  const auto depth = static_cast<std::size_t>(channel["interactions"].at(1).integer());
  std::vector<Ray> found(paths);
  for (std::size_t pair = 0; pair + 1 < offsets.size(); ++pair) {
    for (auto p = static_cast<std::size_t>(offsets[pair]); p < static_cast<std::size_t>(offsets[pair + 1]);
         ++p) {
      Ray& ray = found[p];
      ray.tx = channel["tx"].at(pair / receivers).text(), ray.rx = channel["rx"].at(pair % receivers).text();
      for (std::size_t c = 0; c < carriers; ++c) ray.a.push_back(a[c * paths + p]);
      ray.tau = tau[p], ray.aod = {aod[2 * p], aod[2 * p + 1]}, ray.aoa = {aoa[2 * p], aoa[2 * p + 1]};
      for (std::size_t d = p * depth; d < (p + 1) * depth && kinds[d] != 0; ++d) {
        ray.interactions.push_back(kinds[d]);
        ray.points.push_back({points[3 * d], points[3 * d + 1], points[3 * d + 2]});
        ray.objects.push_back(channel["object_names"].at(static_cast<std::size_t>(objects[d])).text());
      }
    }
  }
  return found;
}

// --- 9 sockets and heartbeats
// --------------------------------------------------------------------------------

using Clock = std::chrono::steady_clock;

inline std::string read_file(const char* path) {
  std::string text;
  std::FILE* file = path && *path ? std::fopen(path, "rb") : nullptr;
  char piece[4096];
  for (std::size_t got = 1; file && got > 0; text.append(piece, got))
    got = std::fread(piece, 1, sizeof piece, file);
  if (file) std::fclose(file);
  return text;
}

// CURVE keys as Z85, 40 characters each; all empty: none (SPEC.md, Transport).
struct Keys {
  std::string own_public, own_secret, broker_public;

  // Of the files that the environment names: CAVIAR_KEY, its own .key, and CAVIAR_BROKER_KEY, the broker's
  // .pub.
  static Keys from_environment(std::string& wrong) {
    const char *own = std::getenv("CAVIAR_KEY"), *broker = std::getenv("CAVIAR_BROKER_KEY");
    if (!own && !broker) return {};
    Keys keys;
    keys.own_public = line(read_file(own), "public");
    keys.own_secret = line(read_file(own), "secret");
    keys.broker_public = line(read_file(broker), "public");
    if (keys.own_public.size() != 40 || keys.own_secret.size() != 40)
      wrong = std::string("CAVIAR_KEY: '") + (own ? own : "") + "' is no .key file of `caviar keys new`";
    else if (keys.broker_public.size() != 40)
      wrong =
          std::string("CAVIAR_BROKER_KEY: '") + (broker ? broker : "") + "' is no .pub file of the broker";
    return keys;
  }

 private:
  static std::string line(const std::string& file, const std::string& what) {
    const std::size_t begin = ("\n" + file).find("\n" + what + " = \"");
    if (begin == std::string::npos) return {};
    const std::size_t from = begin + what.size() + 4;
    return file.substr(from, file.find('"', from) - from);
  }
};

// A DEALER that is connected; null where ZeroMQ refuses the address.
inline void* open_dealer(void* context, const std::string& endpoint, const Keys& keys, int linger_ms) {
  void* socket = zmq_socket(context, ZMQ_DEALER);
  const int unlimited = 0;
  const auto most = static_cast<std::int64_t>(MAX_BODY);
  // Without a limit of what waits for being sent, no call ever blocks the loop of an engine.
  zmq_setsockopt(socket, ZMQ_SNDHWM, &unlimited, sizeof unlimited);
  zmq_setsockopt(socket, ZMQ_LINGER, &linger_ms, sizeof linger_ms);
  zmq_setsockopt(socket, ZMQ_MAXMSGSIZE, &most, sizeof most);
  if (!keys.own_public.empty()) {
    zmq_setsockopt(socket, ZMQ_CURVE_PUBLICKEY, keys.own_public.c_str(), 41);
    zmq_setsockopt(socket, ZMQ_CURVE_SECRETKEY, keys.own_secret.c_str(), 41);
    zmq_setsockopt(socket, ZMQ_CURVE_SERVERKEY, keys.broker_public.c_str(), 41);
  }
  if (zmq_connect(socket, endpoint.c_str()) == 0) return socket;
  zmq_close(socket);
  return nullptr;
}

inline void send_parts(void* socket, const std::vector<Bytes>& parts) {
  for (std::size_t i = 0; socket && i < parts.size(); ++i)
    zmq_send(socket, parts[i].data(), parts[i].size(),
             ZMQ_DONTWAIT | (i + 1 < parts.size() ? ZMQ_SNDMORE : 0));
}

// The next message; false where none is there. Parts beyond what any message has are counted, and not kept.
inline bool receive_parts(void* socket, std::vector<Bytes>& parts) {
  parts.clear();
  for (int more = 1; more;) {
    zmq_msg_t part;
    zmq_msg_init(&part);
    if (zmq_msg_recv(&part, socket, ZMQ_DONTWAIT) < 0) return zmq_msg_close(&part), false;
    more = zmq_msg_more(&part);
    if (parts.size() <= MAX_PARTS)
      parts.emplace_back(static_cast<const char*>(zmq_msg_data(&part)), zmq_msg_size(&part));
    zmq_msg_close(&part);
  }
  return true;
}

// Whether something can be received within a time.
inline bool wait_for(void* socket, std::int64_t milliseconds) {
  zmq_pollitem_t item{socket, 0, ZMQ_POLLIN, 0};
  return zmq_poll(&item, 1, static_cast<long>(std::max<std::int64_t>(0, milliseconds))) > 0;
}

// The heartbeat connection, in a thread of its own, so that a slow frame or a loading level stops no
// heartbeat.
class Heart {
 public:
  Heart() = default;
  Heart(const Heart&) = delete;
  Heart& operator=(const Heart&) = delete;
  ~Heart() { stop(); }

  void start(void* context, const std::string& endpoint, const Keys& keys, Bytes attach,
             const Value& welcome) {
    stop();
    stopping_ = false, lost_ = false;
    const std::chrono::nanoseconds every(welcome["heartbeat_ns"].integer(1)),
        alive(welcome["liveness_ns"].integer(1));
    thread_ = std::thread([this, context, endpoint, keys, attach, every, alive] {
      beat(context, endpoint, keys, attach, every, alive);
    });
  }
  void stop() {
    stopping_ = true;
    if (thread_.joinable()) thread_.join();
  }

  // What the service is doing, and how long that may take without progress; counts as progress.
  void report(std::string phase, double grace_s = 0.0) {
    const std::lock_guard<std::mutex> lock(mutex_);
    phase_ = std::move(phase), grace_ns_ = static_cast<std::int64_t>(grace_s * 1e9), ++progress_;
  }
  bool lost() const { return lost_; }
  std::string reason() {
    const std::lock_guard<std::mutex> lock(mutex_);
    return reason_;
  }

 private:
  void beat(void* context, const std::string& endpoint, const Keys& keys, const Bytes& attach,
            std::chrono::nanoseconds every, std::chrono::nanoseconds alive) {
    void* socket = open_dealer(context, endpoint, keys, 0);
    send_parts(socket, {attach});
    auto heard = Clock::now(), due = heard + every;
    std::vector<Bytes> parts;
    std::int64_t sequence = 0;
    while (socket && !stopping_ && !lost_) {
      const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(due - Clock::now()).count();
      wait_for(socket, std::min<std::int64_t>(left, 20));
      while (!stopping_ && receive_parts(socket, parts)) {
        Message message;
        if (decode_message(std::move(parts), message)) continue;  // noise: the next heartbeat asks again
        if (message.is("HEARTBEAT_ACK")) heard = Clock::now();
        if (message.is("ERROR") || message.is("REFUSE")) lose(message.fields["message"].text());
      }
      if (Clock::now() - heard > alive) lose("the broker is silent");
      if (Clock::now() >= due) send_parts(socket, {heartbeat(sequence++)}), due += every;
      due = std::max(due, Clock::now() - every);  // after a stop of the process, no burst
    }
    if (socket) zmq_close(socket);
  }

  Bytes heartbeat(std::int64_t sequence) {
    const std::lock_guard<std::mutex> lock(mutex_);
    return encode(
        "Heartbeat",
        Value::map(
            {{"sequence", sequence}, {"progress", progress_}, {"phase", phase_}, {"grace_ns", grace_ns_}}));
  }
  void lose(std::string reason) {
    const std::lock_guard<std::mutex> lock(mutex_);
    reason_ = std::move(reason), lost_ = true;
  }

  std::thread thread_;
  std::mutex mutex_;
  std::string phase_, reason_;
  std::int64_t progress_ = 0, grace_ns_ = 0;
  std::atomic<bool> stopping_{false}, lost_{false};
};

// The signal that asked this process to end; 0: none. For programs of their own: an engine calls `leave`.
inline volatile std::sig_atomic_t& stop_signal() {
  static volatile std::sig_atomic_t signal = 0;
  return signal;
}
inline void leave_on_signals() {
  std::signal(SIGTERM, [](int signal) { stop_signal() = signal; });
  std::signal(SIGINT, [](int signal) { stop_signal() = signal; });
}

// --- 10 the world
// --------------------------------------------------------------------------------------------

struct Input {
  std::string topic;
  int lag = 1;
  bool required = false;
  std::vector<std::string> parts{};
};

// A product that came with a GRANT.
struct Product {
  std::string topic, source;
  std::string status;      // fresh or held
  std::int64_t frame = 0;  // that it was computed for
  Value value;
};

// Base of all worlds. Override `step`, and what else the world needs; then `run`, or `connect` and `poll`.
class World {
 public:
  World() = default;
  World(const World&) = delete;
  World& operator=(const World&) = delete;
  virtual ~World() { leave("the program ends"); }

  double welcome_timeout_s = 120.0;  // for the first WELCOME
  int max_in_flight = 4;             // grants that may be queued

  // Takes part in a run until it is over. Returns the exit status: 0 after SHUTDOWN, 1 where this world
  // failed, was refused or has the blame, 128 + n after signal n.
  int run(const std::string& endpoint, const std::string& name) {
    leave_on_signals();
    if (connect(endpoint, name))
      while (poll(100)) continue;
    return status_;
  }

  // Begins to connect to a broker, `tcp://HOST:PORT`, under the scenario's name of this world; never waits.
  bool connect(const std::string& endpoint, const std::string& name) {
    leave("another connection is wanted");
    endpoint_ = endpoint, name_ = name, status_ = 0, faulted_ = rejoining_ = false;
    std::string wrong;
    keys_ = Keys::from_environment(wrong);
    if (!wrong.empty()) return end(wrong);
    context_ = zmq_ctx_new();
    deadline_ = Clock::now() + seconds(welcome_timeout_s);
    return open();
  }

  // Handles what has come, for up to that long; at most one frame is computed. False once the run is over.
  // An engine calls it in every tick: with 0 it returns at once where nothing has come.
  bool poll(int max_wait_ms = 0) {
    const auto until = Clock::now() + std::chrono::milliseconds(max_wait_ms);
    while (stage_ != Stage::over) {
      if (stop_signal()) {
        leave("signal " + std::to_string(stop_signal()));
        status_ = 128 + stop_signal();
        break;
      }
      std::vector<Bytes> parts;
      // First what has come: the last words of a broker that is gone say why. Not all that may come, so that
      // a flood of messages does not hold an engine up.
      for (int left = 64; left > 0 && socket_ && receive_parts(socket_, parts); --left)
        if (handle(std::move(parts)) || stage_ == Stage::over) return stage_ != Stage::over;
      if (!keep_connected()) break;
      const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(until - Clock::now()).count();
      if (stage_ == Stage::over || left <= 0) break;
      // In slices, so that a signal or a silent broker is noticed.
      const std::int64_t slice = std::min<std::int64_t>(left, 20);
      if (socket_)
        wait_for(socket_, slice);
      else
        std::this_thread::sleep_for(std::chrono::milliseconds(slice));
    }
    return stage_ != Stage::over;
  }

  // Says BYE and ends, before the run does.
  void leave(const std::string& reason) {
    if (stage_ != Stage::over && welcomed()) say("Bye", {{"reason", reason}});
    close();
  }

  // Answers a frame that `step` deferred; false where none is.
  bool publish(std::vector<Object> objects) {
    if (!deferred_) return false;
    deferred_ = false;
    finish(std::move(objects));
    while (!deferred_ && !waiting_.empty()) {
      Message next = std::move(waiting_.front());
      waiting_.pop_front();
      on_grant(std::move(next));
    }
    return true;
  }

  int status() const { return status_; }
  bool over() const { return stage_ == Stage::over; }

 protected:
  // Products that the world wants. By default the commands of the frame before, where there are any.
  virtual std::vector<Input> inputs() { return {{"action"}}; }

  // Declares names with `claim`, and offers scenery; called again when the world comes back to a run.
  virtual void prepare() {}

  // Goes to the first state of an episode. `seed` and `seed_episode` are all that randomness may depend on;
  // t0 is the simulated time of frame 0 [s].
  virtual void reset(std::int64_t seed, double t0) { static_cast<void>(seed), static_cast<void>(t0); }

  // The objects at t [s since frame 0 of the episode]. `previous` is that of the frame before, in frame 0 it
  // is t: the world advances by t − previous. Objects that come in one frame get devices in the order of the
  // list.
  virtual std::vector<Object> step(double t, double previous, const std::vector<Command>& commands) = 0;

  // State that outlives a frame, as bytes, and back; false refuses bytes that are none.
  virtual Bytes save() { return {}; }
  virtual bool restore(const Bytes& state) { return state.empty(); }

  // A line for people; an engine shows it in its own log.
  virtual void log(const std::string& line) { std::fprintf(stderr, "%s: %s\n", name_.c_str(), line.c_str()); }

  // --- for use in these callbacks

  // What names of objects begin with: `car.`, or a whole name. In `prepare`.
  void claim(const std::string& prefix) { prefixes_.push_back(prefix); }

  // A line that the broker shows with READY. In `prepare`.
  void note(const std::string& line) { notes_.push_back(line); }

  // Offers a file under a name such as `objects/car.ply`. In `prepare`.
  std::string offer_file(const std::string& name, Bytes data) {
    if (!keeps_rule("AssetName", name)) return fail("asset '" + name + "': a relative path is expected"), "";
    if (files_.count(name)) return fail("asset '" + name + "': it was offered already"), "";
    files_[name] = std::move(data);
    return name;
  }

  // Offers the mesh of objects, in body axes [m]; its file has it fitted into the unit box that `dimensions`
  // scale. In `prepare` it is there for the whole run. In `reset`, `step` and `restore` it comes while the
  // run goes on, and stays as long as an object has it, and 20 frames longer, until the episode ends; a state
  // has no meshes, so that `restore` offers those of its objects again. One that is none is logged then, and
  // its objects are boxes, of at least 1 cm. `material`: of ITU-R P.2040; empty: what the channel's settings
  // say.
  OfferedMesh offer_mesh(const std::string& name, const std::vector<Vector3>& vertices,
                         const std::vector<Triangle>& triangles, const std::string& material = "") {
    const bool runs = stage_ >= Stage::ready;
    Mesh mesh{vertices, triangles};
    std::string wrong = wrong_mesh(mesh);
    if (wrong.empty() && !material.empty()) wrong = wrong_material(material);
    const Box box = bounds(vertices);
    if (runs && wrong.empty()) wrong = wrong_at_run_time(mesh, box);
    OfferedMesh offered{"", box.size, box.centre};
    if (!wrong.empty()) {
      wrong = "mesh '" + name + "': " + wrong;
      if (!runs) return fail(wrong), offered;
      for (double& side : offered.dimensions) side = std::max(side, SMALLEST_M);
      return log_once(wrong + "; objects with it are boxes"), offered;
    }
    for (Vector3& vertex : mesh.vertices)
      for (std::size_t k = 0; k < 3; ++k)
        vertex[k] = box.size[k] > 0 ? (vertex[k] - box.centre[k]) / box.size[k] : 0.0;
    Bytes file = to_ply(mesh, material);
    offered.mesh = runs ? run_time_meshes_.add(std::move(file))
                        : offer_file("objects/" + name + ".ply", std::move(file));
    return offered;
  }

  // Offers the static scenery, in world axes. At most one world of a run does. In `prepare`.
  void offer_scenery(const std::vector<Surface>& surfaces, const std::vector<Material>& materials) {
    if (const std::string wrong = wrong_scenery(surfaces, materials); !wrong.empty()) return fail(wrong);
    offer_file("scenery/scene.xml", to_scene_xml(surfaces, materials));
    for (const Surface& surface : surfaces)
      offer_file("scenery/meshes/" + surface.name + ".ply", to_ply(surface.mesh));
  }

  // Says that the callback failed: FAULT with this line goes to the broker, which names this world.
  void fail(const std::string& line) {
    if (failure_.empty()) failure_ = line;
  }

  // In `step`: the frame is answered by `publish`, later; what `step` returns is not used.
  void defer() { deferred_ = true; }

  // Before work that takes seconds: what it is, and how long it may go without progress.
  void announce(const std::string& phase, double grace_s) { heart_.report(phase, grace_s); }

  const Value& settings() const { return welcome_["settings"]; }
  const Value& scenario() const { return welcome_["scenario"]; }
  std::int64_t seed_episode() const { return seed_episode_; }
  const std::vector<Product>& products() const { return products_; }  // all inputs of this frame, decoded

  std::vector<LinkUser> link_users() const {
    std::vector<LinkUser> found;
    for (const Product& product : products_)
      if (product.topic == "link")
        for (LinkUser& user : users_of(product.value)) found.push_back(std::move(user));
    return found;
  }
  std::vector<Ray> rays() const {
    std::vector<Ray> found;
    for (const Product& product : products_)
      if (product.topic == "channel")
        for (Ray& ray : rays_of(product.value)) found.push_back(std::move(ray));
    return found;
  }

 private:
  enum class Stage : std::uint8_t { over, connecting, joined, ready, active };
  using Entries = std::initializer_list<Value::Entry>;
  static constexpr double SMALLEST_M = 0.01;     // side of the box of a mesh that is refused and has none
  static constexpr std::size_t KEPT = 67108864;  // [B] of answers that are kept for a repeated GRANT
  static constexpr char MAGIC[] = "CAVIAR-WORLD-1\n";

  static Clock::duration seconds(double count) {
    return std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(count));
  }

  // --- connections

  bool welcomed() const { return stage_ >= Stage::joined; }

  bool open() {
    socket_ = open_dealer(context_, endpoint_, keys_, 1000);
    if (!socket_)
      return end("cannot connect to '" + endpoint_ + "': " + zmq_strerror(zmq_errno()) +
                 "; an address is like tcp://127.0.0.1:5555");
    stage_ = Stage::connecting;
    std::vector<Value> wanted;
    for (const Input& input : inputs()) {
      std::vector<Value> parts(input.parts.begin(), input.parts.end());
      wanted.push_back(Value::map({{"topic", input.topic},
                                   {"lag", input.lag},
                                   {"required", input.required},
                                   {"parts", Value::list(parts)}}));
    }
    Value hello = Value::map({{"version", Value::list({PROTOCOL_MAJOR, PROTOCOL_MINOR})},
                              {"name", name_},
                              {"role", "world"},
                              {"inputs", Value::list(wanted)},
                              {"outputs", Value::list({"scene"})},
                              {"capabilities", Value::list({"assets", "checkpoint", "episodes", "geometry"})},
                              {"implementation", "caviar.hpp"},
                              {"max_in_flight", max_in_flight}});
#if defined(__linux__)
    // What lets a broker on this machine see at once that this process has died.
    char space[64] = {};
    std::string boot = read_file("/proc/sys/kernel/random/boot_id");
    boot.erase(boot.find_last_not_of('\n') + 1);
    if (readlink("/proc/self/ns/pid", space, sizeof space - 1) > 0 && !boot.empty())
      hello.set("host", boot + ":" + space).set("pid", static_cast<std::int64_t>(getpid()));
#endif
    send_parts(socket_, {encode("Hello", hello)});
    return true;
  }

  // Notices a lost broker, and comes back; false where it is over.
  bool keep_connected() {
    if (welcomed() && heart_.lost()) return lost("lost the broker: " + heart_.reason());
    if (stage_ != Stage::connecting) return true;
    if (!socket_) return Clock::now() < retry_at_ || open_again();
    if (Clock::now() < deadline_) return true;
    if (rejoining_) return lost("no WELCOME");
    return end("no WELCOME within " + std::to_string(static_cast<int>(welcome_timeout_s)) + " s from " +
               endpoint_ +
               "; is the broker there, and does it ask for keys (CAVIAR_KEY, CAVIAR_BROKER_KEY)?");
  }

  // A broker that waits for this world gets a new incarnation of it, on new sockets (SPEC.md, rejoin_ns).
  bool lost(const std::string& why) {
    const std::chrono::nanoseconds patience(welcome_["rejoin_ns"].integer());
    if (!rejoining_) give_up_at_ = Clock::now() + patience, pause_s_ = 0.1;
    if (patience.count() == 0 || Clock::now() >= give_up_at_) return end(why);
    if (!rejoining_) log(why + "; coming back");
    rejoining_ = true, stage_ = Stage::connecting;
    heart_.stop();
    if (socket_) zmq_close(socket_);
    socket_ = nullptr;
    retry_at_ = Clock::now() + seconds(pause_s_), pause_s_ = std::min(1.0, 2 * pause_s_);
    return true;
  }
  bool open_again() {
    deadline_ = Clock::now() + seconds(5.0);
    return open();
  }

  void close() {
    heart_.stop();
    if (socket_) zmq_close(socket_);
    if (context_) zmq_ctx_term(context_);
    socket_ = context_ = nullptr, stage_ = Stage::over;
  }

  bool end(const std::string& why) {
    log(why);
    close();
    status_ = 1;
    return false;
  }

  // --- sending

  // A message with this world's epoch and attempt.
  void say(const char* type, Entries entries, std::vector<Bytes> parts = {}) {
    parts.insert(parts.begin(), encode(type, stamped(entries)));
    send_parts(socket_, parts);
  }
  Value stamped(Entries entries) const {
    Value fields = Value::map(entries);
    return fields.set("epoch", welcome_["epoch"]).set("attempt", welcome_["attempt"]);
  }
  void refuse(const std::string& code, const std::string& message, const std::string& of,
              const Value& subject = {}) {
    log("refused: " + message);
    send_parts(
        socket_,
        {encode(
            "Error",
            Value::map({{"code", code}, {"message", message}, {"of", of}, {"subject", subject.text()}}))});
  }

  // --- receiving

  // Returns whether a frame was computed.
  bool handle(std::vector<Bytes> parts) {
    Message message;
    if (Problem problem = decode_message(std::move(parts), message)) {
      if (problem.code == "version") return end(problem.message);
      return refuse(problem.code, problem.message, message.type ? message.type->tag : ""), false;
    }
    const Value& fields = message.fields;
    if (message.is("SHUTDOWN")) return on_shutdown(fields);
    if (message.is("REFUSE")) return on_refuse(fields);
    if (message.is("STALE")) return log("its " + fields["of"].text() + " was stale"), false;
    if (message.is("ERROR")) return on_error(fields), false;
    const bool mine = welcomed() && fields["epoch"].integer() == welcome_["epoch"].integer() &&
                      fields["attempt"].integer() == welcome_["attempt"].integer();
    const bool turn = mine && stage_ == Stage::active && fields["episode"].integer() == episode_;
    if (message.is("WELCOME") && stage_ == Stage::connecting) return on_welcome(fields);
    if (message.is("ASSET_GET") && stage_ >= Stage::ready) return serve(fields), false;
    if (message.is("PREPARE") && mine && stage_ == Stage::joined) return on_prepare(fields), false;
    if (message.is("RESET") && mine && stage_ >= Stage::ready) return on_reset(fields), false;
    if (message.is("GRANT") && turn) return on_grant(std::move(message));
    if (message.is("CHECKPOINT") && turn) return on_checkpoint(fields), false;
    if (message.is("RESTORE") && turn && newest_ < 0) return on_restore(fields, message.parts[0]);
    if (message.is("EPISODE_END") && turn) return false;
    if (message.is("CANCEL") && mine) return false;  // advice: the frame is answered all the same
    return refuse("unexpected", message.type->tag + " is not due", message.type->tag), false;
  }

  bool on_welcome(const Value& fields) {
    welcome_ = fields, rejoining_ = false, stage_ = Stage::joined;
    forget();
    mounts_.adopt(scenario()["devices"]);
    heart_.start(context_, endpoint_, keys_, encode("Attach", stamped({{"name", name_}})), welcome_);
    return false;
  }

  bool on_refuse(const Value& fields) {
    const std::string why = fields["code"].text() + ": " + fields["message"].text();
    if (!rejoining_ || fields["code"].text() != "name-taken") return end(why);
    lost(why);
    return false;
  }

  bool on_shutdown(const Value& fields) {
    const std::string reason = fields["reason"].text();
    // A reason that blames a service begins with its role and name.
    const bool blamed = faulted_ || reason.rfind("world '" + name_ + "' ", 0) == 0;
    log("the run is over: " + reason);
    leave("");
    status_ = blamed ? 1 : 0;
    return false;
  }

  void on_error(const Value& fields) {
    log(fields["code"].text() + ": " + fields["message"].text());
    if (fields["code"].text() == "refused-mesh") run_time_meshes_.refuse(fields["subject"].text());
  }

  void on_prepare(const Value& fields) {
    prefixes_.clear(), files_.clear(), notes_.clear(), failure_.clear();
    run_time_meshes_.max_faces = fields["max_faces"].integer();
    heart_.report("prepare");
    prepare();
    if (!failure_.empty()) return fault("prepare", -1, failure_);
    for (const std::string& name : mounts_.fixed_names()) prefixes_.push_back(name);
    std::sort(prefixes_.begin(), prefixes_.end());
    prefixes_.erase(std::unique(prefixes_.begin(), prefixes_.end()), prefixes_.end());
    std::vector<Value> assets;
    digests_.clear();
    for (const auto& [name, data] : files_) {
      const std::string digest = sha256(data);
      digests_[digest] = name;
      assets.push_back(Value::map({{"name", name}, {"digest", digest}, {"size", data.size()}}));
    }
    stage_ = Stage::ready;
    if (!assets.empty()) say("AssetOffer", {{"assets", Value::list(assets)}});
    say("Ready", {{"geometry", geometry_digest(files_)},
                  {"prefixes", Value::list({prefixes_.begin(), prefixes_.end()})},
                  {"notes", Value::list({notes_.begin(), notes_.end()})}});
  }

  void serve(const Value& get) {
    const std::string digest = get["digest"].text();
    const auto offered = digests_.find(digest);
    const Bytes* data = offered == digests_.end() ? run_time_meshes_.find(digest) : &files_[offered->second];
    const auto offset = static_cast<std::size_t>(get["offset"].integer());
    if (data == nullptr || offset > data->size())
      return refuse("unknown-asset", "no asset has this digest, or so many bytes", "ASSET_GET",
                    get["digest"]);
    const Value answer = Value::map({{"digest", digest}, {"offset", offset}, {"size", data->size()}});
    send_parts(socket_, {encode("AssetData", answer), data->substr(offset, MAX_ASSET_CHUNK)});
  }

  void forget() {
    answers_.clear(), waiting_.clear(), mounts_.clear(), logged_.clear();
    kept_ = 0, newest_ = -1, deferred_ = false, previous_ns_.reset();
    run_time_meshes_.reset(was_here_before());
  }

  // Whether the broker may know meshes that an earlier process of this world announced.
  bool was_here_before() const {
    return welcome_["epoch"].integer(1) > 1 || welcome_["attempt"].integer(1) > 1;
  }

  std::string wrong_at_run_time(const Mesh& mesh, const Box& box) const {
    const auto faces = static_cast<std::int64_t>(mesh.triangles.size()), most = run_time_meshes_.max_faces;
    if (most > 0 && faces > most)
      return "it has " + std::to_string(faces) + " triangles, and this run takes " + std::to_string(most);
    if (!(box.size[0] > 0 && box.size[1] > 0 && box.size[2] > 0)) return "it is flat";
    return {};
  }

  void log_once(const std::string& line) {
    if (!logged_[line]) log(line);
    logged_[line] = true;
  }

  void on_reset(const Value& fields) {
    forget();
    episode_ = fields["episode"].integer(), t0_ns_ = fields["t0_ns"].integer();
    seed_episode_ = fields["seed_episode"].integer(), failure_.clear();
    heart_.report("reset");
    reset(fields["seed"].integer(), static_cast<double>(t0_ns_) / 1e9);
    if (!failure_.empty()) return fault("reset", -1, failure_);
    stage_ = Stage::active;
    say("ResetDone", {{"episode", episode_}});
  }

  // --- frames

  bool on_grant(Message message) {
    const std::int64_t frame = message.fields["frame"].integer();
    const auto stored = answers_.find(frame);
    if (stored != answers_.end()) return send_parts(socket_, stored->second), false;
    if (frame <= newest_)
      return refuse("unexpected", "frame " + std::to_string(frame) + " is over", "GRANT"), false;
    if (deferred_) return waiting_.push_back(std::move(message)), false;
    grant_ = std::move(message);
    failure_.clear(), commands_.clear(), products_.clear();
    if (!read_inputs()) return true;
    heart_.report("frame " + std::to_string(frame));
    const std::int64_t t_ns = grant_.fields["t_ns"].integer();
    const auto since = [this](std::int64_t at) { return static_cast<double>(at - t0_ns_) / 1e9; };
    began_ = Clock::now();
    std::vector<Object> objects = step(since(t_ns), since(previous_ns_.value_or(t_ns)), commands_);
    if (!deferred_) finish(std::move(objects));
    return true;
  }

  // Decodes the products of a GRANT; one that cannot be used is answered with FAULT, which blames its source.
  bool read_inputs() {
    std::size_t part = 0;
    for (const Value& input : grant_.fields["inputs"].items()) {
      if (input["status"].text() == "absent") continue;
      Product product{input["topic"].text(),
                      input["source"].text(),
                      input["status"].text(),
                      input["frame"].integer(-1),
                      {}};
      const Bytes &header = grant_.parts[part], &body = grant_.parts[part + 1];
      part += 2;
      Problem problem = decode_payload(product.topic, header, body, product.value);
      // Larger ones are compared by the recorder.
      const std::string stated = input["digest"].text();
      if (!problem && header.size() + body.size() <= 16384 && !stated.empty() &&
          stated != product_digest(header, body))
        problem = malformed(product.topic + ": its bytes have another digest than its DONE said");
      if (problem.code == "limit") return refuse("limit", problem.message, "GRANT"), false;
      const std::string what = product.topic + " of " + product.source + ": " + problem.message;
      if (problem) return fault("decode", frame(), what, product.source), false;
      for (Command& command : commands_of(product.value, product.source))
        commands_.push_back(std::move(command));
      products_.push_back(std::move(product));
    }
    return true;
  }

  std::int64_t frame() const { return grant_.fields["frame"].integer(); }

  void finish(std::vector<Object> objects) {
    if (failure_.empty()) failure_ = wrong_objects(objects);
    if (!failure_.empty()) return fault("step", frame(), failure_);
    for (Object& object : objects) {
      if (!is_mesh_name(object.mesh)) continue;
      if (run_time_meshes_.max_faces == 0)
        object.mesh.clear();  // the run takes no meshes now
      else if (!run_time_meshes_.has(object.mesh))
        log_once(object.mesh + " is not there; objects with it are boxes until offer_mesh() brings it");
    }
    const std::chrono::nanoseconds took = Clock::now() - began_;
    const std::optional<Value> change = run_time_meshes_.change(frame(), objects);
    std::map<std::string, Value> devices = mounts_.devices(objects);
    for (const Object& object : objects)
      if (devices.count(object.name))
        return fault("step", frame(), "object '" + object.name + "': name is that of a device");
    auto [header, body] = encode_scene(std::move(objects), devices);
    if (header.size() > MAX_HEADER) return fault("step", frame(), "the header of the scene exceeds 1 MiB");
    Value product = Value::map({{"topic", "scene"}, {"digest", product_digest(header, body)}});
    Value done = stamped({{"episode", episode_},
                          {"frame", frame()},
                          {"products", Value::list({product})},
                          {"measured", Value::map({{"step", took.count()}})}});
    if (change) done.set("geometry", *change);
    answer({encode("Done", done), std::move(header), std::move(body)});
    previous_ns_ = grant_.fields["t_ns"].integer();
  }

  std::string wrong_objects(const std::vector<Object>& objects) const {
    std::map<std::string, bool> names;
    for (const Object& object : objects) {
      if (const std::string wrong = wrong_object(object, prefixes_, files_); !wrong.empty()) return wrong;
      if (names.count(object.name)) return "object '" + object.name + "': name is in the frame twice";
      names[object.name] = true;
    }
    return {};
  }

  void fault(const char* phase, std::int64_t frame, const std::string& line,
             const std::string& culprit = "") {
    log(std::string(phase) + ": " + line);
    faulted_ = true;
    const Value fields = stamped({{"episode", std::max<std::int64_t>(0, episode_)},
                                  {"frame", frame},
                                  {"phase", phase},
                                  {"message", line},
                                  {"culprit", culprit}});
    if (frame < 0)
      send_parts(socket_, {encode("Fault", fields)});
    else
      answer({encode("Fault", fields)});
  }

  // Sends the answer to a GRANT, and keeps it for one that is repeated.
  void answer(std::vector<Bytes> parts) {
    send_parts(socket_, parts);
    newest_ = frame();
    for (const Bytes& part : parts) kept_ += part.size();
    answers_[newest_] = std::move(parts);
    while (kept_ > KEPT && answers_.size() > 1) {
      for (const Bytes& part : answers_.begin()->second) kept_ -= part.size();
      answers_.erase(answers_.begin());
    }
  }

  // --- state: the time of the last frame and the order in which objects came, then what `save` gives

  void on_checkpoint(const Value& fields) {
    failure_.clear();
    const std::vector<std::string> arrived = mounts_.arrived();
    Packer head;
    head.value(Value::map({{"arrived", Value::list({arrived.begin(), arrived.end()})},
                           {"previous_ns", previous_ns_ ? Value(*previous_ns_) : Value()}}));
    const Bytes own = save();
    if (!failure_.empty()) return fault("save", -1, failure_);
    char length[4];
    for (std::size_t i = 0; i < 4; ++i) length[i] = static_cast<char>(head.out.size() >> (8 * i));
    say("CheckpointDone", {{"episode", episode_}, {"frame", fields["frame"]}},
        {MAGIC + Bytes(length, 4) + head.out + own});
  }

  bool on_restore(const Value& fields, const Bytes& state) {
    constexpr std::size_t begin = sizeof MAGIC - 1 + 4;
    std::size_t length = 0;
    Value head;
    bool right = state.rfind(MAGIC, 0) == 0 && state.size() >= begin;
    for (std::size_t i = 0; right && i < 4; ++i)
      length |= static_cast<std::size_t>(static_cast<std::uint8_t>(state[begin - 4 + i])) << (8 * i);
    right = right && length <= state.size() - begin &&
            !Unpacker(std::string_view(state).substr(begin, length)).read(head);
    failure_.clear();
    run_time_meshes_.reset(was_here_before(), fields["frame"].integer() + 1);
    if (!right || !restore(state.substr(begin + length)) || !failure_.empty()) {
      fault("restore", -1, failure_.empty() ? "RESTORE has a state that is none of this world" : failure_);
      return end("it cannot go on from the state that it was given");
    }
    std::vector<std::string> arrived;
    for (const Value& name : head["arrived"].items()) arrived.push_back(name.text());
    mounts_.clear(std::move(arrived));
    if (head["previous_ns"].is(Value::Kind::integer)) previous_ns_ = head["previous_ns"].integer();
    newest_ = fields["frame"].integer();
    say("Ready", {});
    return false;
  }

  std::string endpoint_, name_ = "world";
  Keys keys_;
  void *context_ = nullptr, *socket_ = nullptr;
  Heart heart_;
  Stage stage_ = Stage::over;
  int status_ = 0;
  bool faulted_ = false;  // whether this world failed
  bool rejoining_ = false;
  double pause_s_ = 0.1;
  Clock::time_point deadline_{}, retry_at_{}, give_up_at_{}, began_{};

  Value welcome_;
  Mounts mounts_;
  std::vector<std::string> prefixes_, notes_;
  std::map<std::string, Bytes> files_;          // scenery by name
  std::map<std::string, std::string> digests_;  // name by digest
  RunTimeMeshes run_time_meshes_;
  std::map<std::string, bool> logged_;
  std::string failure_;

  std::int64_t episode_ = -1, t0_ns_ = 0, seed_episode_ = 0, newest_ = -1;
  std::optional<std::int64_t> previous_ns_;
  Message grant_;
  std::deque<Message> waiting_;
  bool deferred_ = false;
  std::vector<Command> commands_;
  std::vector<Product> products_;
  std::map<std::int64_t, std::vector<Bytes>> answers_;
  std::size_t kept_ = 0;
};

}  // namespace caviar

#endif  // CAVIAR_HPP
