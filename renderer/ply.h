// The rows of one element of a PLY file: bytes in, columns out.
#pragma once

#include <bit>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace chromeball {

// Types are numpy's letters: b B h H i I f d.
struct PlyProperty {
  char count;  // type of the list's length, or 0: one value
  char type;
  bool keep;
};

struct PlyColumn {
  std::vector<int32_t> sizes;     // of a list
  std::vector<float> reals;       // of types f and d
  std::vector<int32_t> integers;  // of the others; what does not fit is -1
};

enum class PlyFormat { text, little, big };

class PlyReader {
 public:
  PlyReader(std::string_view data, PlyFormat format)
      : start_(data.data()), at_(start_), end_(start_ + data.size()), format_(format) {}

  // Throws std::invalid_argument where the data end early or are no numbers.
  std::vector<PlyColumn> rows(uint64_t count, const std::vector<PlyProperty>& properties) {
    std::vector<PlyColumn> columns(properties.size());
    if (properties.empty()) return columns;
    uint64_t least = 0;  // bytes of a row
    for (const PlyProperty& p : properties) {
      least += format_ == PlyFormat::text ? 1 : size(p.count ? p.count : p.type);
    }
    if (count > uint64_t(end_ - at_) / least) early();
    for (size_t k = 0; k < properties.size(); ++k) {
      const PlyProperty& p = properties[k];
      if (!p.keep) continue;
      if (p.count) columns[k].sizes.reserve(count);
      const uint64_t values = p.count ? 3 * count : count;
      if (p.count && values > uint64_t(end_ - at_)) continue;
      is_real(p.type) ? columns[k].reals.reserve(values) : columns[k].integers.reserve(values);
    }
    for (uint64_t row = 0; row < count; ++row) {
      for (size_t k = 0; k < properties.size(); ++k) {
        const PlyProperty& p = properties[k];
        PlyColumn& column = columns[k];
        uint64_t values = 1;
        if (p.count) {
          const double n = next(p.count);
          if (!(n >= 0 && n <= double(end_ - at_))) early();
          values = uint64_t(n);
          if (p.keep) column.sizes.push_back(int32_t(std::min(n, 2147483647.0)));
        }
        for (uint64_t i = 0; i < values; ++i) {
          const double value = next(p.type);
          if (!p.keep) continue;
          if (is_real(p.type)) {
            column.reals.push_back(float(value));
          } else {
            const bool fits = value >= 0 && value <= 2147483647.0;
            column.integers.push_back(fits ? int32_t(value) : -1);
          }
        }
      }
    }
    return columns;
  }

  size_t consumed() const { return size_t(at_ - start_); }

 private:
  [[noreturn]] static void early() {
    throw std::invalid_argument("truncated: the data end before the last row");
  }

  static bool is_real(char type) { return type == 'f' || type == 'd'; }

  static size_t size(char type) {
    switch (type) {
      case 'b': case 'B': return 1;
      case 'h': case 'H': return 2;
      case 'i': case 'I': case 'f': return 4;
      case 'd': return 8;
    }
    throw std::invalid_argument("unknown type");
  }

  double next(char type) { return format_ == PlyFormat::text ? word(type) : binary(type); }

  double binary(char type) {
    const size_t n = size(type);
    if (size_t(end_ - at_) < n) early();
    unsigned char bytes[8];
    std::memcpy(bytes, at_, n);
    at_ += n;
    if ((format_ == PlyFormat::big) != (std::endian::native == std::endian::big)) {
      for (size_t k = 0; k < n / 2; ++k) std::swap(bytes[k], bytes[n - 1 - k]);
    }
    switch (type) {
      case 'b': return as<int8_t>(bytes);
      case 'B': return as<uint8_t>(bytes);
      case 'h': return as<int16_t>(bytes);
      case 'H': return as<uint16_t>(bytes);
      case 'i': return as<int32_t>(bytes);
      case 'I': return as<uint32_t>(bytes);
      case 'f': return double(as<float>(bytes));
      default: return as<double>(bytes);
    }
  }

  template <typename T>
  static T as(const unsigned char* bytes) {
    T value;
    std::memcpy(&value, bytes, sizeof value);
    return value;
  }

  double word(char type) {
    while (at_ < end_ && is_space(*at_)) ++at_;
    if (at_ < end_ && *at_ == '+') ++at_;
    const char* start = at_;
    while (at_ < end_ && !is_space(*at_)) ++at_;
    if (start == at_) early();
    double value = 0;
    const auto [stop, error] = std::from_chars(start, at_, value);
    if (stop != at_ || error == std::errc::invalid_argument) {
      throw std::invalid_argument("'" + printable({start, size_t(at_ - start)}) +
                                  "' is no number");
    }
    if (error == std::errc::result_out_of_range) {
      const std::string_view text(start, size_t(at_ - start));
      value = text.find('-', 1) != text.npos ? 0 : HUGE_VAL;
    }
    if (!is_real(type) && value != std::floor(value)) {
      throw std::invalid_argument("'" + printable({start, size_t(at_ - start)}) +
                                  "' is no whole number");
    }
    return value;
  }

  static bool is_space(char c) { return c == ' ' || (c >= '\t' && c <= '\r'); }

  static std::string printable(std::string_view text) {
    std::string out(text.substr(0, 40));
    for (char& c : out) {
      if (c < 0x20 || c > 0x7e) c = '?';
    }
    return out;
  }

  const char* start_;
  const char* at_;
  const char* end_;
  PlyFormat format_;
};

}  // namespace chromeball
