# make build    ROS 2 Jazzy (the sourced one, else its wheels in .venv) and the package in install/
# make demo     the main job on a simulated sensor: a table, and plots in demo_output/
# make check    linters, types and fast tests: what a change needs, about two minutes on two cores
# make test     every test, eight to twelve minutes on two cores  (make test ARGS='-k fit')
# make perf     limits of processor time, for a quiet machine
# make bench    latency and CPU of the live nodes, and each job beside its rivals
# make reference  docs/reference, and figures in the pages, from the package and the measurements
# make gallery  the pictures of the effects
# make site     the documentation as a site in site/, with search
# make screenshots  docs/screenshots: terminals and pages from real runs, six minutes
# make animation  docs/gap.svg, README's animation, from a simulated log and its diagnosis, two minutes
# make reproduction  docs/measurements/reproduction.md and its plots: the paper's experiments on simulated units
# make coverage do the intervals hold? 300 drawn units and stages, as a table
# make investigate  minutes to a verdict of `investigate` over 60 simulated units, an hour
# make kept     kept calibrations of simulated robots over 60 days, five minutes
# make blind    the blind check of diagnose, 600 trials, into blind_output/ (make blind ARGS='--seed 1')
# make working  working cases of diagnose, one line each, then the scores (make working ARGS='--count 20 --seed 3')
# make lint     the linters alone
# make clean    remove what these made

.PHONY: build developed help demo check test perf bench reference gallery site screenshots reproduction coverage investigate kept blind working lint clean \
    FORCE
.DEFAULT_GOAL := build

# The first Python that can run the line $1.
pythons := $(PYTHON) python3 python3.13 python3.12 python3.11 python3.10 /usr/bin/python3
first_python = $(shell for p in $(pythons); do \
    "$$p" -c '$1' >/dev/null 2>&1 && { echo "$$p"; break; }; done)
fits := import ensurepip, sys; v = sys.version_info[:2]; \
    assert sys.implementation.name == "cpython" and (3, 10) <= v <= (3, 13)

ifeq ($(ROS_DISTRO),jazzy)
ros_python := $(call first_python,import rclpy)
endif
ifdef ros_python
mode := ros
base_python = $(ros_python)
requirements := $(patsubst %,requirements/%.txt,build core extras)
else
mode := wheels
base_python = $(call first_python,$(fits))
requirements := $(patsubst %,requirements/%.txt,ros build core extras)
ifdef ROS_DISTRO
# Another ROS that is sourced must not mix with the wheels.
unexport ROS_DISTRO PYTHONPATH LD_LIBRARY_PATH AMENT_PREFIX_PATH
endif
endif
# The wheels' Python sets LD_LIBRARY_PATH for its venv and tells its children that this is done;
# our venv may be another one.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE

# .venv/.ready says what the venv was made for. If that was another ROS or place, or if it is
# missing because an installation was cut short, the venv is made anew. A recent pip finds versions
# that fit each other in seconds; that of Python 3.10 looks for half an hour.
made_for := $(mode) $(CURDIR)
ifneq ($(made_for),$(shell test -x .venv/bin/python && cat .venv/.ready 2>/dev/null))
.venv/.ready: FORCE
make_venv = python='$(base_python)'; \
    [ -n "$$python" ] || { echo 'make: no CPython 3.10 to 3.13 with venv found: install python3' \
        'and python3-venv, or say make PYTHON=/path/to/python' >&2; exit 1; }; \
    echo "making .venv with $$python, ROS 2 from: $(mode)"; \
    rm -rf .venv && \
    "$$python" -m venv $(if $(ros_python),--system-site-packages) .venv && \
    .venv/bin/python -m pip install --quiet --disable-pip-version-check 'pip>=24' && \
    { .venv/bin/python -m pip freeze | grep -E '^(numpy|scipy|pytest)==' || :; } \
        > .venv/constraints.txt
endif

# pip compiles on one core. Some packages have templates of Python that do not compile.
install = echo 'installing into .venv: $(1)'; \
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-compile \
    --constraint .venv/constraints.txt $(1:%=--requirement %) && \
    { .venv/bin/python -m compileall -qq -j 0 .venv/lib || :; }

# The constraints keep the versions that an installed ROS was built with.
.venv/.ready: $(requirements)
	@$(make_venv)
	@rm -f $@
	@$(call install,$(requirements))
	@echo '$(made_for)' > $@

# What only tests and development need, so that the demonstration need not wait for it.
development := requirements/test.txt
.venv/.developed: .venv/.ready $(development)
	@$(call install,$(development))
	@touch $@

# Directories count, too: their time changes when a file in them is removed.
sources := package.xml setup.py setup.cfg \
    $(shell find adxl_ros adxl_ros_validation launch params resource security share -name __pycache__ -prune -o -print)

build: install/.built

developed: build .venv/.developed

help:
	@sed -n 's/^# \(make .*\)/\1/p' Makefile

# Made from nothing, so that a module that is gone from the sources is gone from install/.
# Modules are compiled even where PYTHONDONTWRITEBYTECODE forbids it at the start of each tool.
install/.built: .venv/.ready $(sources)
	@rm -rf build install
	@.venv/bin/python -m colcon build --paths .
	@.venv/bin/python -m compileall -q install/adxl_ros/lib
	@test -e install/adxl_ros/share/adxl_ros/hook/ament_prefix_path.sh || { echo 'make: colcon' \
	    'did not build an ament package: does package.xml validate?' >&2; exit 1; }
	@touch $@

# A recording of a real sensor beside the clone is fitted, too.
real := $(wildcard ../shared/real/mpu9150_0.csv)

demo: build
	./run demo -o demo_output
	$(if $(real),./run fit $(real) -o demo_output/real.yaml)

# In test/, so that Python imports the installed package and not the sources beside it.
pytest = cd test && OPENBLAS_NUM_THREADS=1 ../run --exec python -m pytest -q

check: developed
	$(pytest) -n 2 --dist loadgroup -m 'not (live or long or perf)' $(ARGS)

# A test of live nodes waits for half of its time: three share two cores.
test: developed
	$(pytest) -n 3 --dist loadgroup -m 'not perf' $(ARGS)

perf: developed
	$(pytest) -m perf $(ARGS)

lint: developed
	$(pytest) project/test_linters.py project/test_layering.py

# Rivals that do not install are left out of the table.
bench: build
	-.venv/bin/python -m pip install --quiet --disable-pip-version-check \
	    --requirement requirements/bench.txt
	./run bench --iiod test/support/iiod.py $(ARGS)

gallery: build
	./run --exec python docs/gallery.py

reference: build
	./run --exec python docs/reference.py

site: build .venv/.documented
	OPENBLAS_NUM_THREADS=1 ./run --exec python -m sphinx -W --keep-going -q -E -c docs . site
	@echo '<meta http-equiv="refresh" content="0; url=docs/index.html">' > site/index.html
	@echo 'wrote site/index.html'

.venv/.documented: .venv/.ready requirements/docs.txt
	@$(call install,requirements/docs.txt)
	@touch $@

# One of them: make screenshots ARGS=diagnose. Pages need Chromium: apt install chromium.
screenshots: developed
	OPENBLAS_NUM_THREADS=1 ./run --exec python docs/screenshots.py docs $(ARGS)

animation: build
	OPENBLAS_NUM_THREADS=1 ./run --exec python docs/animation.py

reproduction: build
	OPENBLAS_NUM_THREADS=1 ./run reproduce --units 40 --draws 300 -o docs/measurements $(ARGS)

coverage: build
	OPENBLAS_NUM_THREADS=1 ./run reproduce --units 0 --draws 300 -o coverage_output $(ARGS)

# Goes on where it was cut short.
investigate: build
	OPENBLAS_NUM_THREADS=1 ./run --exec python docs/measurements/investigate_units.py \
	    -o investigate_units.jsonl $(ARGS)

kept: build
	OPENBLAS_NUM_THREADS=1 ./run --exec python docs/measurements/kept_robots.py $(ARGS)

# Goes on where it was cut short; with a seed of its own in ARGS, into another folder.
blind: build
	./run blind -o blind_output $(ARGS)

working: build
	OPENBLAS_NUM_THREADS=1 ./run --exec python -m adxl_ros_validation.working_cases $(ARGS)

clean:
	rm -rf .venv build install log demo_output blind_output working_output coverage_output site jupyter_execute .*_cache .hypothesis
	find adxl_ros adxl_ros_validation launch test -name __pycache__ -prune -exec rm -rf {} +
