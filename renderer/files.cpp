// The Python face of the readers of mesh files: bytes in, arrays out, the GIL released.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include "obj.h"
#include "ply.h"
#include "polygon.h"

namespace nb = nanobind;
using namespace chromeball;

namespace {

using Points = nb::ndarray<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Integers = nb::ndarray<const int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;

std::string_view text_of(const nb::bytes& data) { return {data.c_str(), data.size()}; }

// A vector that numpy owns from now on; columns 0: one-dimensional.
template <typename T>
nb::object array(std::vector<T>&& values, size_t columns = 0) {
  auto* kept = new std::vector<T>(std::move(values));
  nb::capsule owner(kept, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  if (columns == 0) {
    return nb::cast(nb::ndarray<nb::numpy, T, nb::ndim<1>>(kept->data(), {kept->size()}, owner));
  }
  return nb::cast(nb::ndarray<nb::numpy, T, nb::ndim<2>>(
      kept->data(), {kept->size() / columns, columns}, owner));
}

// Names in files are of any encoding.
nb::list strings(const std::vector<std::string>& values) {
  nb::list out;
  for (const std::string& value : values) {
    out.append(nb::steal(PyUnicode_DecodeUTF8(value.data(), Py_ssize_t(value.size()),
                                              "surrogateescape")));
  }
  return out;
}

}  // namespace

NB_MODULE(files, m) {
  m.def(
      "read_obj",
      [](nb::bytes data) {
        Obj obj;
        {
          const std::string_view text = text_of(data);
          nb::gil_scoped_release release;
          obj = ObjReader(text).read();
        }
        return nb::make_tuple(array(std::move(obj.positions), 3), array(std::move(obj.uvs), 2),
                              array(std::move(obj.normals), 3),
                              array(std::move(obj.vertices), 3), array(std::move(obj.sizes)),
                              array(std::move(obj.corners)), array(std::move(obj.materials)),
                              strings(obj.names), strings(obj.libraries), obj.left_out);
      },
      nb::arg("data"));

  m.def(
      "read_ply_rows",
      [](nb::bytes data, size_t offset, int format, uint64_t count,
         const std::vector<std::tuple<std::string, std::string, bool>>& properties) {
        if (offset > data.size()) throw nb::value_error("offset");
        std::vector<PlyProperty> wanted;
        for (const auto& [count_type, type, keep] : properties) {
          wanted.push_back({count_type.empty() ? '\0' : count_type[0], type.at(0), keep});
        }
        std::vector<PlyColumn> columns;
        size_t end = 0;
        {
          PlyReader reader(text_of(data).substr(offset), PlyFormat(format));
          nb::gil_scoped_release release;
          columns = reader.rows(count, wanted);
          end = offset + reader.consumed();
        }
        nb::list out;
        for (size_t k = 0; k < columns.size(); ++k) {
          PlyColumn& column = columns[k];
          const bool real = wanted[k].type == 'f' || wanted[k].type == 'd';
          nb::object values =
              real ? array(std::move(column.reals)) : array(std::move(column.integers));
          out.append(nb::make_tuple(array(std::move(column.sizes)), values));
        }
        return nb::make_tuple(out, end);
      },
      nb::arg("data"), nb::arg("offset"), nb::arg("format"), nb::arg("count"),
      nb::arg("properties"));

  m.def(
      "triangulate",
      [](Points vertices, Integers sizes, Integers corners) {
        Triangulation out;
        {
          nb::gil_scoped_release release;
          out = Triangulator().run(std::span(vertices.data(), vertices.size()),
                                   std::span(sizes.data(), sizes.size()),
                                   std::span(corners.data(), corners.size()));
        }
        return nb::make_tuple(array(std::move(out.corners), 3), array(std::move(out.faces)));
      },
      nb::arg("vertices"), nb::arg("sizes"), nb::arg("corners"));
}
