# docker build -t mpfa . && docker run --rm -v mpfa-runs:/home/robot/runs mpfa      trains and evaluates the demo
# --build-arg TORCH_INSTALL_ARGS='...' installs another build of PyTorch, as for `make`.
FROM python:3.11-slim
# PyTorch compiles the updates of longer runs with g++.
RUN apt-get update && apt-get install --yes --no-install-recommends g++ make && rm -rf /var/lib/apt/lists/*
RUN useradd --create-home robot
USER robot
WORKDIR /home/robot
COPY --chown=robot . .
ARG TORCH_INSTALL_ARGS=
RUN mkdir -p runs && make .venv/.installed TORCH_INSTALL_ARGS="$TORCH_INSTALL_ARGS" PIP_NO_CACHE_DIR=1
CMD ["make", "demo"]
