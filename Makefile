# `make demo` and `make test` set themselves up; once that is done it costs nothing again.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

# uv from the PATH if it runs (pyenv's shim may be there and fail), else our own in .tools/
UV := $(shell uv --version >/dev/null 2>&1 && echo uv || echo .tools/bin/uv)
RUN := .venv/bin/
READY := .venv/.ready
SOURCES := pyproject.toml CMakeLists.txt .python-version \
  $(wildcard */CMakeLists.txt */*.cpp */*.h */*/*.cpp */*/*.h)
DATA ?=
SECONDS_OF_FUZZ ?= 60

.PHONY: help setup demo office test lint bench sanitize clean

help:
	@echo 'make demo    set up, photograph the virtual set, run every stage, print composite and report'
	@echo 'make office  the same on a real light probe: make office DATA=folder/of/fisheye_lumilab'
	@echo 'make test    set up and run the tests'
	@echo 'make bench   run time against error, beside the peers'
	@echo 'make lint    ruff, mypy and pyright'
	@echo 'make sanitize  broken files and worlds against the core with its sanitizers on'
	@echo 'make clean   remove what was built'

setup: $(READY)

# The system's part: a C++ compiler, Embree and oneTBB.
.venv/.system:
	@if ! dpkg -s libembree-dev libtbb-dev g++ >/dev/null 2>&1; then \
	  need='apt-get install -y --no-install-recommends libembree-dev libtbb-dev g++'; \
	  if [ "$$(id -u)" = 0 ]; then sudo=; \
	  elif sudo -n true 2>/dev/null; then sudo=sudo; \
	  else echo "chromeball needs Embree, oneTBB and a C++ compiler; run once: sudo $$need"; exit 1; fi; \
	  $$sudo apt-get update -qq && $$sudo env DEBIAN_FRONTEND=noninteractive $$need; \
	fi
	@mkdir -p .venv && touch $@

.tools/bin/uv:
	@for p in $${PYENV_ROOT:-$$HOME/.pyenv}/versions/3.13*/bin/python3.13 python3 /usr/bin/python3; do \
	  $$p -m venv --clear .tools 2>/dev/null && break; \
	done; \
	[ -x .tools/bin/pip ] || { \
	  if [ "$$(id -u)" = 0 ]; then sudo=; else sudo=sudo; fi; \
	  $$sudo apt-get update -qq && $$sudo apt-get install -y python3-venv && /usr/bin/python3 -m venv --clear .tools; }
	@.tools/bin/pip install --quiet uv

# Python 3.13: from the PATH or from pyenv's versions folder (its shims may be there and fail),
# else uv is left to find or fetch one.
$(READY): $(SOURCES) | .venv/.system $(filter .tools/bin/uv,$(UV))
	@python=3.13; \
	for p in python3.13 $${PYENV_ROOT:-$$HOME/.pyenv}/versions/3.13*/bin/python3.13; do \
	  if $$p -c 'import sys; sys.exit(sys.version_info[:2] != (3, 13))' 2>/dev/null; then python=$$p; break; fi; \
	done; \
	[ -x .venv/bin/python ] || { $(UV) venv --quiet --allow-existing --python $$python .venv; }
	$(UV) sync --quiet --inexact --only-group build
	$(UV) sync --quiet --all-extras
	@touch $@

demo: $(READY)
	@$(RUN)chromeball demo

office: $(READY)
	@[ -n "$(DATA)" ] || { echo 'make office DATA=folder: the folder that holds JPEG/*.JPG'; exit 2; }
	@$(RUN)chromeball new office --example office --set data="$(DATA)" --if-absent
	@PATH="$(CURDIR)/.venv/bin:$$PATH" $(MAKE) --no-print-directory -C office

test: $(READY)
	$(RUN)pytest -n 2 --dist worksteal --benchmark-disable

lint: $(READY)
	$(RUN)ruff check .
	$(RUN)ruff format --check .
	$(RUN)mypy
	$(RUN)pyright

bench: $(READY)
	$(RUN)chromeball bench

# The core with address and undefined sanitizers, then a minute of broken files and worlds.
sanitize: $(READY)
	@$(RUN)cmake -S . -B build/sanitize -G Ninja -DCMAKE_BUILD_TYPE=Release \
	  -DCHROMEBALL_SANITIZE=ON -DPython_EXECUTABLE="$(CURDIR)/.venv/bin/python" \
	  -Dnanobind_DIR="$$($(RUN)python -m nanobind --cmake_dir)" >/dev/null
	@$(RUN)cmake --build build/sanitize --target renderer_core renderer_files
	@LD_PRELOAD="$$(g++ -print-file-name=libasan.so) $$(g++ -print-file-name=libstdc++.so)" \
	ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
	  $(RUN)python -m tests.renderer.sanitize build/sanitize --seconds $(SECONDS_OF_FUZZ)

clean:
	rm -rf .venv .tools build dist demo office
