# make install   the environment .venv, with ROS 2 (rclpy), torch and the tools
# make shell     a shell in which `pnv` and `place_recognizer` are found
# make demo      a sequence through the real node; IMAGES=DIR, VIDEO=FILE or BAG=DIR take your own
# make slam-demo a pose graph closed by the node
# make test      every test
# make faults    the fault tests at full counts, and their table; minutes
# make soak      the node for an hour (SECONDS=3600): memory, latency, threads and file handles as out/soak.png
# make bench     the benchmarks
# make docs      the documentation as a site in out/site, every link checked
# make lint      ruff and mypy

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
MESSAGES := .venv/.messages

# torch of PyPI carries CUDA (about 3 GB); this release is taken without it wherever an index offers it so (version +cpu).
TORCH := torch==2.13.0
TORCH_CPU := https://download.pytorch.org/whl/cpu
REACHABLE = $(PYTHON) -c "import urllib.request as r; r.urlopen('$(TORCH_CPU)/torch/', timeout=5)" 2>/dev/null

SHELL := /bin/bash -o pipefail
# pip, which says on a terminal what it is at, on one line; elsewhere nothing but errors.
PIP = pip() { if [ -t 1 ]; then $(BIN)/pip install --progress-bar off "$$@" | while read -r word what _; do \
    case $$word in Collecting|Downloading|Installing) printf '\r\033[K    %.70s' "$$word $$what";; esac; done; \
    local code=$$?; printf '\r\033[K'; return $$code; \
    else $(BIN)/pip install --progress-bar off -q "$$@"; fi; }

.PHONY: install shell demo slam-demo fleet-demo test faults soak bench docs lint clean

install: $(READY) $(MESSAGES)

$(READY): setup.py setup.cfg pyproject.toml
	@echo "installing into .venv: ROS 2, torch and the tools, a few minutes and about 2 GB"
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv || \
	    { echo "python3 -m venv failed; on Debian: apt-get install python3-venv" >&2; exit 2; }
	@$(PIP); $(BIN)/python -c "import torch" 2>/dev/null || { echo "  torch"; \
	    if $(REACHABLE); then pip $(TORCH) --extra-index-url $(TORCH_CPU); else pip $(TORCH); fi; }
	@echo "  rclpy, the message packages and the tools"
	@$(PIP); pip -e ".[ros,dev,interfaces]"
	@touch $@
	@echo "installed; for pnv and place_recognizer on the PATH: source .venv/bin/activate, or make shell"

$(MESSAGES): $(READY) $(wildcard pnv_msgs/* pnv_msgs/*/*)
	@$(BIN)/python .ci/build_interfaces.py pnv_msgs
	@touch $@

shell: $(READY)
	@echo "pnv and place_recognizer are on the PATH of this shell; exit leaves it"
	@PATH="$(CURDIR)/$(BIN):$$PATH" VIRTUAL_ENV="$(CURDIR)/.venv" $${SHELL:-bash}

demo: $(READY)
	@echo "demo: a camera and the node as two processes, over ROS 2; about two minutes"
	@$(BIN)/python -m examples.demo $(if $(IMAGES),--images "$(IMAGES)") $(if $(VIDEO),--video "$(VIDEO)") \
	    $(if $(BAG),--bag "$(BAG)") $(ARGS)

slam-demo: $(READY)
	@echo "slam-demo: a pose graph closed by the node, over ROS 2; some minutes"
	@$(BIN)/python -c "import gtsam, evo" 2>/dev/null || $(BIN)/pip install --progress-bar off -q -e ".[slam]"
	@$(BIN)/python -m examples.pose_graph $(ARGS)

fleet-demo: $(READY)
	@echo "fleet-demo: three robots and a Milvus Lite server, over ROS 2; about three minutes"
	@$(BIN)/python -c "import pymilvus, milvus_lite, gtsam" 2>/dev/null || \
	    $(BIN)/pip install --progress-bar off -q -e ".[fleet,slam]"
	@$(BIN)/python -m examples.fleet $(ARGS)

test: $(READY) $(MESSAGES)
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist loadfile $(ARGS)

faults: $(READY)
	@mkdir -p out && rm -f out/faults.jsonl
	@status=0; PNV_FULL_TESTS=1 PNV_ROS_FAULTS=full PNV_FAULT_TABLE=$(CURDIR)/out/faults.jsonl OMP_NUM_THREADS=1 \
	    $(BIN)/python -m pytest -p no:randomly test/maps test/database/test_failing_disk.py \
	    test/decide/test_odometry.py test/decide/test_calibration.py test/adapters/test_camera_info.py test/core/test_files.py \
	    test/ros/test_faults.py test/ros/test_hostile_inputs.py test/ros/test_saving.py test/ros/test_endings.py \
	    test/ros/test_reference.py test/ros/test_security.py test/cli/test_hostile_values.py $(ARGS) || status=$$?; \
	    $(BIN)/python -m test.tally out/faults.jsonl; exit $$status

soak: $(READY)
	@mkdir -p out
	@$(BIN)/python -m test.ros.soak --seconds $(or $(SECONDS),3600) --output out/soak.png

bench: $(READY)
	@$(BIN)/python -m benchmarks.run

docs: $(READY)
	@$(BIN)/python -c "import material" 2>/dev/null || $(BIN)/pip install --progress-bar off -q -e ".[docs]"
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet && echo "out/site/index.html"

lint: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

clean:
	rm -rf build install log out *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
