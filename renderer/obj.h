// Wavefront OBJ: text in, arrays out.
#pragma once

#include <charconv>
#include <climits>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

namespace chromeball {

struct Obj {
  std::vector<float> positions;     // (P, 3)
  std::vector<float> uvs;           // (T, 2), v up as OBJ has it
  std::vector<float> normals;       // (N, 3)
  std::vector<int32_t> vertices;    // (V, 3) position, uv and normal of each vertex, or -1
  std::vector<int32_t> sizes;       // (F,) corners of each face
  std::vector<int32_t> corners;     // (C,) vertex of each corner
  std::vector<int32_t> materials;   // (F,) name of each face's material, or -1
  std::vector<std::string> names;
  std::vector<std::string> libraries;
  int64_t left_out = 0;             // lines, points and curves
};

class ObjReader {
 public:
  explicit ObjReader(std::string_view text) : at_(text.data()), end_(at_ + text.size()) {}

  // Throws std::invalid_argument with the line for what is no OBJ.
  Obj read() {
    for (; at_ < end_; next_line()) {
      const std::string_view word = token();
      if (word == "v") {
        numbers(obj_.positions, 3, 3);
      } else if (word == "vt") {
        numbers(obj_.uvs, 1, 2);
      } else if (word == "vn") {
        numbers(obj_.normals, 3, 3);
      } else if (word == "f" || word == "fo") {
        face();
      } else if (word == "usemtl") {
        material_ = number_of(std::string(rest()));
      } else if (word == "mtllib") {
        obj_.libraries.emplace_back(rest());
      } else if (word == "l" || word == "p" || word == "curv" || word == "surf") {
        ++obj_.left_out;
      }
    }
    const int64_t counts[3] = {int64_t(obj_.positions.size() / 3),
                               int64_t(obj_.uvs.size() / 2),
                               int64_t(obj_.normals.size() / 3)};
    for (size_t kind = 0; kind < 3; ++kind) {
      for (size_t i = kind; i < obj_.vertices.size(); i += 3) {
        if (obj_.vertices[i] >= counts[kind]) {
          throw std::invalid_argument(std::string("a face names ") + kNames[kind] + " " +
                                      std::to_string(obj_.vertices[i] + int64_t(1)) +
                                      ", the mesh has " + std::to_string(counts[kind]));
        }
      }
    }
    return std::move(obj_);
  }

 private:
  static constexpr const char* kNames[3] = {"vertex", "texture coordinate", "normal"};
  struct Key {
    int32_t v[3];
    bool operator==(const Key& o) const {
      return v[0] == o.v[0] && v[1] == o.v[1] && v[2] == o.v[2];
    }
  };
  struct Hash {
    size_t operator()(const Key& k) const {
      uint64_t h = 0x9e3779b97f4a7c15u;
      for (const int32_t x : k.v) h = (h ^ uint32_t(x)) * 0xff51afd7ed558ccdu, h ^= h >> 32;
      return size_t(h);
    }
  };

  [[noreturn]] void fail(const std::string& what) const {
    std::string text = "line " + std::to_string(line_) + ": " + what;
    for (char& c : text) {
      if (c < 0x20 || c > 0x7e) c = '?';
    }
    throw std::invalid_argument(text);
  }

  static bool is_space(char c) { return c == ' ' || c == '\t' || c == '\r' || c == '\v'; }

  // Past blanks, and past line ends that a backslash continues.
  void skip_blanks() {
    while (at_ < end_) {
      if (is_space(*at_)) {
        ++at_;
      } else if (*at_ == '\\' && continues()) {
        ++line_;
        at_ += at_[1] == '\r' ? 3 : 2;
      } else {
        break;
      }
    }
  }
  bool continues() const {
    return (end_ - at_ > 1 && at_[1] == '\n') ||
           (end_ - at_ > 2 && at_[1] == '\r' && at_[2] == '\n');
  }

  // The next word of the line; empty at its end and at a comment.
  std::string_view token() {
    skip_blanks();
    if (at_ < end_ && *at_ == '#') return {};
    const char* start = at_;
    while (at_ < end_ && !is_space(*at_) && *at_ != '\n' && !(*at_ == '\\' && continues())) {
      ++at_;
    }
    return {start, size_t(at_ - start)};
  }

  std::string_view rest() {
    skip_blanks();
    const char* start = at_;
    while (at_ < end_ && *at_ != '\n') ++at_;
    const char* stop = at_;
    while (stop > start && is_space(stop[-1])) --stop;
    return {start, size_t(stop - start)};
  }

  void next_line() {
    while (at_ < end_ && *at_ != '\n') ++at_;
    if (at_ < end_) ++at_;
    ++line_;
  }

  void numbers(std::vector<float>& to, int least, int wanted) {
    if (to.size() / size_t(wanted) >= size_t(INT32_MAX)) fail("too many");
    for (int k = 0; k < wanted; ++k) {
      std::string_view word = token();
      if (word.empty()) {
        if (k < least) fail(std::to_string(least) + " numbers expected");
        to.push_back(0);
        continue;
      }
      if (word.front() == '+') word.remove_prefix(1);
      double value = 0;
      const auto [stop, error] = std::from_chars(word.data(), word.data() + word.size(), value);
      if (stop != word.data() + word.size() || error == std::errc::invalid_argument) {
        fail("'" + std::string(word.substr(0, 40)) + "' is no number");
      }
      if (error == std::errc::result_out_of_range) value = tiny(word) ? 0 : HUGE_VAL;
      to.push_back(float(value));
    }
  }
  static bool tiny(std::string_view word) { return word.find("-", 1) != word.npos; }

  void face() {
    const size_t first = obj_.corners.size();
    const char* start = at_;
    const int64_t counts[3] = {int64_t(obj_.positions.size() / 3),
                               int64_t(obj_.uvs.size() / 2),
                               int64_t(obj_.normals.size() / 3)};
    for (std::string_view word = token(); !word.empty(); word = token()) {
      Key key{{-1, -1, -1}};
      for (int k = 0; k < 3; ++k) {
        const size_t slash = word.find('/');
        const std::string_view part = word.substr(0, slash);
        if (!part.empty()) {
          key.v[k] = index(part, counts[k], k);
        } else if (k == 0) {
          fail("a corner of a face names no vertex");
        }
        if (slash == word.npos) break;
        if (k == 2) fail("a corner of a face has more than three numbers");
        word.remove_prefix(slash + 1);
      }
      obj_.corners.push_back(vertex(key));
    }
    const size_t n = obj_.corners.size() - first;
    const auto position = [&](size_t k) {
      return obj_.vertices[3 * size_t(obj_.corners[first + k])];
    };
    if (n < 3 || (n == 3 && (position(0) == position(1) || position(1) == position(2) ||
                             position(2) == position(0)))) {
      const std::string_view text(start, size_t(at_ - start));
      fail("a face has fewer than three corners: f" + std::string(text.substr(0, 60)));
    }
    obj_.sizes.push_back(int32_t(n));
    obj_.materials.push_back(material_);
  }

  // Counted from 1, or back from the newest where negative.
  int32_t index(std::string_view word, int64_t count, int kind) {
    int64_t value = 0;
    const auto [stop, error] = std::from_chars(word.data(), word.data() + word.size(), value);
    if (error != std::errc() || stop != word.data() + word.size()) {
      fail("'" + std::string(word.substr(0, 40)) + "' is no number of a vertex");
    }
    const int64_t from_zero = value < 0 ? count + value : value - 1;
    if (from_zero < 0 || from_zero >= INT32_MAX) {
      fail(std::string("a face names ") + kNames[kind] + " " + std::to_string(value) +
           ", the mesh has " + std::to_string(count));
    }
    return int32_t(from_zero);
  }

  int32_t vertex(const Key& key) {
    const auto [place, fresh] = known_.try_emplace(key, int32_t(obj_.vertices.size() / 3));
    if (fresh) obj_.vertices.insert(obj_.vertices.end(), key.v, key.v + 3);
    return place->second;
  }

  int32_t number_of(std::string name) {
    const auto [place, fresh] = materials_.try_emplace(name, int32_t(obj_.names.size()));
    if (fresh) obj_.names.push_back(std::move(name));
    return place->second;
  }

  const char* at_;
  const char* end_;
  int64_t line_ = 1;
  int32_t material_ = -1;
  Obj obj_;
  std::unordered_map<Key, int32_t, Hash> known_;
  std::unordered_map<std::string, int32_t> materials_;
};

}  // namespace chromeball
