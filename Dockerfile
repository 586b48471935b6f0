# The project on a CPU. `docker build -t icrl4aht-data . && docker run icrl4aht-data` runs the demo.
FROM python:3.11-slim
RUN apt-get update && apt-get install --yes --no-install-recommends make && rm -rf /var/lib/apt/lists/*
WORKDIR /icrl4aht-data
COPY . .
# What `make demo` needs; `make install` would also install the tools of developers.
RUN python -m venv .venv \
    && .venv/bin/python -m pip install --no-cache-dir --editable '.[baselines]' --constraint constraints.txt \
    && touch .venv/installed
CMD ["make", "demo"]
