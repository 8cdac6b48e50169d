// The hdr room's kernels as one Python module.

#include "kernel.h"

NB_MODULE(kernel, m) {
  bind_response(m);
  bind_merge(m);
  bind_align(m);
  bind_ghost(m);
}
