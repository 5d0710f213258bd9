# SPDX-License-Identifier: Apache-2.0
# From a fresh clone with Python 3.10 or newer: `make demo`, `make test`. `make` alone lists all.
#
# Everything is installed into .venv. In a shell where ROS 2 Jazzy is sourced, that ROS is used;
# elsewhere ROS 2 Jazzy comes as wheels, into .venv too. The two are never mixed: the stamp that
# says .venv is ready carries which of them (and which Python) it was made for.

PYTHON ?= python3
CONFIG ?= recommended
DURATION ?= 60
# Of tests on two cores: many wait for other processes.
WORKERS ?= 3
MINUTES ?= 30
# s, after which a test ends: far more than any needs, also one that compiles first.
LIMIT ?= 900
EXAMPLES ?= 300

.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

# The interpreter beneath, if PYTHON is one of a virtual environment (such as an activated .venv).
BASE := $(shell $(PYTHON) -c 'import sys; print(sys._base_executable)' 2>/dev/null)
VERSION := $(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)

ifeq ($(ROS_DISTRO),jazzy)
FLAVOUR := sourced
else
FLAVOUR := wheels
# The wheels find their own libraries and packages; another ROS or environment must not get in.
unexport AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH PYTHONPATH RMW_IMPLEMENTATION
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
ifneq ($(ROS_DISTRO),)
unexport LD_LIBRARY_PATH ROS_DISTRO ROS_PYTHON_VERSION ROS_VERSION
endif
endif

VENV := .venv
READY := $(VENV)/.ready-$(FLAVOUR)-$(VERSION)
# Bytecode is left to the first import: most of what is installed is never imported.
PIP_INSTALL := $(VENV)/bin/python -m pip --disable-pip-version-check install --no-compile
# This checkout comes first, also before a workspace that has the package installed.
RUN := PYTHONPATH="$(CURDIR)$${PYTHONPATH:+:$$PYTHONPATH}" $(VENV)/bin/python
PIP_LOG := $(VENV)/pip.log
PIP_FAILED := { tail -n 5 $(PIP_LOG) >&2; echo 'The installation failed: $(PIP_LOG) says why.' \
  'It needs a package index: behind a proxy set HTTPS_PROXY, for a mirror PIP_INDEX_URL,' \
  'without a network PIP_FIND_LINKS and PIP_NO_INDEX=1, and run make again.' >&2; exit 1; }

.PHONY: help venv demo paper arms changes test test-browser pictures test-nightly soak fuzz docs lint clean bench release

help: ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1	\2/p' Makefile

venv: $(READY)-test $(READY)-lint ## Install all for runs, tests and lint into .venv (others do it when needed)

demo: $(READY) ## Run the closed loop over ROS 2 (CONFIG, DURATION in s) and plot it, into out/
	@mkdir -p out; out=out/demo; n=1; \
	while [ -e "$$out" ]; do n=$$((n + 1)); out=out/demo-$$n; done; \
	$(RUN) -m blf_dsc_controller run --mode lockstep --config "$(CONFIG)" \
	    --duration "$(DURATION)" --out "$$out" && \
	echo && echo "Pictures to look at:" && ls "$$out"/*.png && echo "The recording: $$out/bag"

paper: $(READY) ## Run the paper's simulation with every law and check its claims, into out/
	@mkdir -p out; out=out/paper; n=1; \
	while [ -e "$$out" ]; do n=$$((n + 1)); out=out/paper-$$n; done; \
	$(RUN) -m benchmark paper --out "$$out"

arms: $(READY) ## Compare laws on a Panda and a UR5e with wrong URDFs, into out/
	@mkdir -p out; out=out/arms; n=1; \
	while [ -e "$$out" ]; do n=$$((n + 1)); out=out/arms-$$n; done; \
	$(RUN) -m benchmark arms --out "$$out"

# A file's tests stay together on one of the workers, for what they set up is shared; the files
# come in the order of test/conftest.py. Bytecode is kept, also where the environment says not to,
# as containers do: each of the many processes would compile the package's sources again.
test: $(READY)-test ## Run the tests (TESTS=test/test_x.py for some, WORKERS=0 in one process)
	@PYTHONDONTWRITEBYTECODE= PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 $(RUN) -m pytest -p xdist \
	    -p _hypothesis_pytestplugin -p pytest_timeout --timeout $(LIMIT) \
	    -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(TESTS)

test-browser: $(READY)-test ## Test the pages of report and view in a headless Chromium, if installed
	@$(PIP_INSTALL) --quiet playwright > $(PIP_LOG) 2>&1 || $(PIP_FAILED)
	@BROWSER_TESTS=1 $(RUN) -m pytest -rs test/test_browser.py

pictures: $(READY)-test ## Make the README's animation, doc/view.webp, with a headless Chromium
	@$(PIP_INSTALL) --quiet playwright -e '.[meshes]' --no-build-isolation \
	    > $(PIP_LOG) 2>&1 || $(PIP_FAILED)
	@PYTHONPATH="$(CURDIR):$(CURDIR)/test" $(VENV)/bin/python test/view_pictures.py

test-nightly: ## Run all tests, those left out by make test as well, at length and with random examples
	@NIGHTLY=1 PYTEST_ADDOPTS='-m "" -rP' $(MAKE) test LIMIT=7200

changes: $(READY)-monte-carlo ## Simulate 14,000 randomly changing arms, each with and without learning, into out/changes
	@$(RUN) -m benchmark changes --out out/changes

bench: $(READY)-bench ## Run the benchmarks into benchmark/RESULTS.md (GROUPS=offline: only print one group)
	@$(RUN) -m benchmark bench $(GROUPS)

soak: $(READY)-test ## Run half an hour of plant time (MINUTES) with a fault every few seconds
	@$(RUN) test/soak.py --minutes "$(MINUTES)"

docs: $(READY)-docs ## Build the documentation site, into out/docs; dead links are errors
	@$(RUN) -m sphinx -q -W --keep-going -n doc out/docs && \
	echo 'Open out/docs/index.html'

release: $(READY)-release ## Check versions and metadata, and build sdist and wheel into out/dist
	@$(MAKE) test TESTS=test/test_package.py
	@rm -rf blf_dsc_controller/compiled/kernels; for arm in recommended panda; do \
	    $(RUN) -m blf_dsc_controller doctor --compile package --config $$arm || exit 1; done
	@rm -rf out/dist && $(VENV)/bin/python -m build --outdir out/dist . && \
	$(VENV)/bin/python -m twine check --strict out/dist/*
	@! grep -q '@users[.]noreply' package.xml || echo 'package.xml has no maintainer that can be' \
	    'reached, and so has what is in out/dist: see CONTRIBUTING.md before you publish it.'

fuzz: $(READY)-test ## Feed random files and names to everything that reads them (EXAMPLES of each kind)
	@EXAMPLES="$(EXAMPLES)" NIGHTLY=1 PYTEST_ADDOPTS='-m ""' $(MAKE) test LIMIT=7200 \
	    TESTS='test/test_fuzzing.py -k survived'

lint: $(READY)-lint ## Check style, types and layers
	@good=1; for check in 'ruff check' 'ruff format --check' mypy; do \
	    $(VENV)/bin/python -m $$check || good=0; done; \
	PYTHONPATH="$(CURDIR)" $(VENV)/bin/lint-imports || good=0; test $$good = 1

clean: ## Remove everything installed and built; keep the results in out/
	@rm -rf $(VENV) build install log *.egg-info .coverage .hypothesis .*_cache \
	    blf_dsc_controller/compiled/kernels
	@find benchmark blf_dsc_controller sim_plant test -name __pycache__ -prune -exec rm -rf {} +

$(READY): setup.py setup.cfg
	@$(check_python)
	@$(check_$(FLAVOUR))
	@test -e $@ || { echo 'Making $(VENV) with Python $(VERSION), for $(about_$(FLAVOUR))'; \
	    "$(BASE)" -m venv --clear $(venv_options_$(FLAVOUR)) $(VENV); } || { \
	    echo 'python -m venv failed: see above. On Debian and Ubuntu: apt install python3-venv' >&2; \
	    exit 1; }
	@echo '1/2 Installing what runs and pictures need: 250 MB to download, 800 MB' \
	    'unpacked, 1 to 3 minutes; pip writes into $(PIP_LOG)'
	@: > $(VENV)/constraints.txt; $(constrain_$(FLAVOUR))
	@{ $(PIP_INSTALL) 'pip>=22' 'setuptools>=70.1' && $(PIP_INSTALL) -c $(VENV)/constraints.txt \
	    --no-build-isolation -e '.[$(extras_$(FLAVOUR))]'; } > $(PIP_LOG) 2>&1 || $(PIP_FAILED)
	@echo '2/2 Installed. A first run compiles, for about a minute: each kernel is announced'
	@touch $@

# Further packages, named after the extra in setup.cfg.
$(READY)-%: $(READY)
	@echo 'Installing what make $* needs besides: up to a minute; pip writes into $(PIP_LOG)'
	@$(PIP_INSTALL) -c $(VENV)/constraints.txt --no-build-isolation -e '.[$*]' \
	    > $(PIP_LOG) 2>&1 || $(PIP_FAILED)
	@touch $@

define check_python
test -n '$(VERSION)' || { echo '$(PYTHON) does not run: install Python 3.10 or newer, or name one:' \
    'make PYTHON=/path/to/python3' >&2; exit 1; }; \
'$(PYTHON)' -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
    echo '$(PYTHON) is Python $(VERSION), but 3.10 or newer is needed: name one:' \
    'make PYTHON=/path/to/python3' >&2; exit 1; }
endef

about_wheels := ROS 2 Jazzy from wheels
extras_wheels := ros,report,view
venv_options_wheels :=
constrain_wheels := :
define check_wheels
test "$$(uname -sm)" = 'Linux x86_64' || { echo "ROS 2 Jazzy as wheels exists for Linux on x86_64" \
    "only, and this is $$(uname -sm): install ROS 2 Jazzy, source it, and run make again." >&2; \
    exit 1; }; \
test -z '$(ROS_DISTRO)' || echo 'ROS 2 $(ROS_DISTRO) is sourced here, but this package is for' \
    'Jazzy: it is left aside, and Jazzy is taken from wheels.'
endef

# numpy stays as it is, because the sourced ROS's messages were compiled against it; nor does
# pyarrow 26 load with a numpy before 2, which pip cannot know.
about_sourced := the ROS 2 Jazzy sourced in this shell
extras_sourced := report,view
venv_options_sourced := --system-site-packages
constrain_sourced := "$(BASE)" -c 'import numpy; v = numpy.__version__; \
    print(f"numpy=={v}"); v < "2" and print("pyarrow<26")' > $(VENV)/constraints.txt
define check_sourced
"$(BASE)" -c 'import rclpy' || { echo 'ROS 2 Jazzy is sourced here, but $(BASE) (Python $(VERSION))' \
    'cannot import its rclpy: see above. Name the Python that this ROS was built for, as in' \
    'make PYTHON=/usr/bin/python3, or use a shell without ROS.' >&2; exit 1; }
endef
