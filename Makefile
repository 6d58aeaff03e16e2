# One command per thing that users and CI do; `make help` lists them.
# Needs Rust, a C++ compiler, make, and Python 3 with pip. Everything else is provisioned by `make setup`.
#
# All code is built in the release profile, so that `make train`, `make test` and `make check` share what
# they compile (the C++ of torch-sys alone takes minutes).

PROVISION := python3 setup/provision.py
# LIBTORCH, ORT_DYLIB_PATH and, after `make test`, CAUDATA_MUJOCO_PYTHON.
ENV := . ./.cargo/env.sh &&
# The same for the robot's processor, after `make setup-arm`.
ARM := . ./.cargo/arm.sh &&
ARM_TARGET := aarch64-unknown-linux-gnu
# Packages whose programs and module the wheel carries.
WHEEL_PARTS := caudata caudata-actor caudata-learner caudata-policy-server caudata-deploy caudata-ros2 caudata-python
DENY_VERSION := 0.20.2
ARGS ?=

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help setup build train test test-fast check lint doc deny advisories bench wheel dist install test-faults setup-arm build-arm test-arm wheel-arm pi-image fuzz siege soak mutants media docs lines clean tools

help: ## list the targets
	@echo 'caudata: make <target> [ARGS="..."]'
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: tools ## provision libtorch and ONNX Runtime into ~/.cache/caudata (LIBTORCH, ORT_DYLIB_PATH: your own)
	@$(PROVISION)

build: setup ## build the release binaries into target/release
	@$(ENV) cargo build --release --locked --workspace

train: build ## train the quick preset on this machine; more with ARGS="--actors 4 --out runs/mine"
	@$(ENV) target/release/caudata train --preset quick $(ARGS)

test: tools ## run all tests but the long fault suites; ARGS goes to cargo test
	@$(PROVISION) --with-mujoco
	@cd setup && python3 -m unittest -b test_provision
	@$(ENV) cargo build --release --locked --workspace
	@$(ENV) cargo test --release --locked --workspace $(ARGS)
	$(if $(ARGS),,@$(ENV) python3 setup/dist.py --test && python3 setup/wheel.py --test)

dist: build ## pack programs, libraries, robots and policies as a relocatable archive into target/
	@$(ENV) python3 setup/dist.py

install: build ## install all that into PREFIX (default: ~/.local)
	@$(ENV) python3 setup/dist.py --install "$(or $(PREFIX),$(HOME)/.local)"

wheel: build ## build the Python wheel into target/wheels (Python 3.10 or newer)
	@$(ENV) python3 setup/wheel.py

test-fast: setup ## unit tests, compiled quickly: for every save; ARGS goes to cargo test
	@$(ENV) cargo test --release --locked --workspace --lib --bins --config setup/fast.toml $(ARGS)

test-faults: build ## run the long suites that `make test` leaves out (faults, soak, a real ROS 2)
	@$(PROVISION) --with-mujoco --with-ros2
	@$(ENV) cargo test --release --locked --workspace $(ARGS) -- --ignored --nocapture

setup-arm: setup ## provision what builds for the robot's processor (aarch64) and runs it here (Debian on x86-64, as root)
	@python3 setup/arm.py

build-arm: ## build the robot's programs for aarch64 into target/arm
	@[ -f .cargo/arm.sh ] || { echo 'make: nothing is provisioned for aarch64: run `make setup-arm` first' >&2; exit 1; }
	@$(ARM) cargo build --release --locked --target $(ARM_TARGET) -p caudata-deploy -p caudata-ros2 --bins

test-arm: build build-arm ## run the robot's programs of aarch64 under emulation: lanes, policies, the client over the servo bus
	@$(ARM) $${RUSTC:-rustc} --edition 2024 --test -O --target $(ARM_TARGET) -C linker=$$CC_aarch64_unknown_linux_gnu -o target/arm/lanes setup/arm_lanes.rs && target/arm/lanes
	@$(ARM) cargo test --release --locked --target $(ARM_TARGET) -p caudata-policy --lib -- running --nocapture
	@$(ARM) printf '#!/bin/sh\nexport ORT_DYLIB_PATH=%s QEMU_LD_PREFIX=%s QEMU_CPU=%s\nexec %s "$$@"\n' "$$ORT_DYLIB_PATH" "$$QEMU_LD_PREFIX" "$$QEMU_CPU" "$$CARGO_TARGET_DIR/$(ARM_TARGET)/release/caudata-robot" >target/arm/robot && chmod +x target/arm/robot
	@$(ENV) CAUDATA_ROBOT_PROGRAM=$(CURDIR)/target/arm/robot cargo test --release --locked --workspace --test it -- $(or $(ARGS),wire::the_program wire::doctor wire::a_robot_on_its_back) --nocapture --test-threads 1
	@ls -l target/arm/$(ARM_TARGET)/release/caudata-robot target/arm/$(ARM_TARGET)/release/caudata-ros2

wheel-arm: ## build the Python wheel for aarch64 into target/arm/wheels and try it under emulation
	@[ -f .cargo/arm.sh ] || { echo 'make: nothing is provisioned for aarch64: run `make setup-arm` first' >&2; exit 1; }
	@$(ARM) cargo build --release --locked --target $(ARM_TARGET) $(foreach part,$(WHEEL_PARTS),-p $(part)) --lib --bins
	@python3 setup/wheel.py --arm --test

pi-image: build-arm ## build an SD card for a Raspberry Pi Zero 2 W, as root; ARGS="--ssh-key FILE --wifi FILE", then ARGS=--boot starts it in QEMU
	@python3 setup/pi_image.py $(ARGS)

fuzz: setup ## knock at every door that bytes come in by, led by coverage, a minute each; ARGS="--seconds 10 rollout_frame"
	@$(ENV) python3 setup/fuzz.py $(ARGS)

siege: build ## attack the real programs in every way of the catalogue (tests/tests/it/siege), CAUDATA_SIEGE=times (20)
	@$(ENV) CAUDATA_SIEGE=$(or $(CAUDATA_SIEGE),20) cargo test --release --locked --workspace --test it $(or $(ARGS),siege) -- --nocapture

soak: build ## a publisher that never pauses, a server that dies, a network that breaks, a robot that follows: ten minutes, CAUDATA_SOAK_S=seconds
	@$(ENV) CAUDATA_SOAK_S=$(or $(CAUDATA_SOAK_S),600) cargo test --release --locked --workspace --test it $(ARGS) -- soak:: --nocapture

mutants: build ## leave out one verification step of robot and server after the other, and show that its bad policy gets through
	@$(ENV) cargo test --release --locked --workspace --lib $(ARGS) -- --nocapture each_step_and_no_other

bench: build ## measure this machine: ARGS="sim", "train" or "transport", with --json for figures
	@$(ENV) target/release/caudata bench $(or $(ARGS),sim)

check: lint doc deny ## everything a change must pass besides the tests: lint, doc, deny

lint: setup ## format and clippy, warnings are errors
	$(call need-cargo,fmt,rustup component add rustfmt)
	$(call need-cargo,clippy,rustup component add clippy)
	@cargo fmt --all --check
	@$(ENV) cargo clippy --release --locked --workspace --all-targets -- -D warnings

doc: setup ## build the documentation, warnings are errors
	@$(ENV) RUSTDOCFLAGS='-D warnings' cargo doc --release --locked --workspace --no-deps

deny: tools ## licences, duplicate dependencies, sources (installs cargo-deny into the cache once, minutes)
	@$(DENY) && cargo deny --locked --workspace check --hide-inclusion-graph bans licenses sources

advisories: tools ## known security advisories of the dependencies (fetches the advisory database with git)
	@$(DENY) && cargo deny --locked --workspace check advisories

media: build ## draw the pictures of the README again
	@$(ENV) python3 setup/media.py

docs: ## build the documentation as a site that needs no network, into target/site
	@python3 setup/site.py

lines: ## count the product: lines of Rust without tests, generated code and doc comments
	@python3 setup/lines.py

clean: ## remove target/ (the provisioned libraries stay in ~/.cache/caudata)
	@cargo clean

# The pinned cargo-deny on PATH: the user's own if it is that version, else built into the cache.
# Installed into a folder of its own and renamed last, so that a broken build is not taken for a finished one.
define DENY
cache="$${XDG_CACHE_HOME:-$$HOME/.cache}/caudata"; root="$$cache/cargo-deny-$(DENY_VERSION)"; \
export PATH="$$root/bin:$$PATH"; \
if [ "$$(cargo deny --version 2>/dev/null)" != "cargo-deny $(DENY_VERSION)" ]; then \
	echo "make: installing cargo-deny $(DENY_VERSION) into $$root, this takes minutes"; \
	rm -rf "$$root.tmp" && \
	cargo install --quiet --locked --no-track --root "$$root.tmp" cargo-deny@$(DENY_VERSION) && \
	rm -rf "$$root" && mv "$$root.tmp" "$$root"; \
fi
endef

# $(call need,TOOL,WHAT TO DO) and $(call need-cargo,SUBCOMMAND,WHAT TO DO): one line where something is missing.
need = @command -v $(1) >/dev/null 2>&1 || { echo "make: $(1) is missing: $(2)" >&2; exit 1; }
need-cargo = @cargo $(1) --version >/dev/null 2>&1 || { echo "make: cargo $(1) is missing: $(2)" >&2; exit 1; }

tools:
	$(call need,cargo,install Rust with rustup and put ~/.cargo/bin on PATH)
	$(call need,$${CXX:-c++},install a C++17 compiler (Debian: apt install g++) or set CXX)
	$(call need,python3,install Python 3.8 or newer (Debian: apt install python3 python3-pip))
	@python3 -m pip --version >/dev/null 2>&1 || { echo "make: pip is missing: install it (Debian: apt install python3-pip)" >&2; exit 1; }
