# uav-twin in a container, with the pinned packages of requirements.lock and compiled loops.
#
#   docker build -t uav-twin .
#   docker run --rm -v "$PWD:/work" --user "$(id -u)" uav-twin run level_turns --out runs/first
FROM python:3.11-slim

# The packages first: they are built again only if the lock changes.
COPY requirements.lock /opt/uav-twin/
RUN pip install --no-cache-dir --require-hashes -r /opt/uav-twin/requirements.lock

COPY pyproject.toml README.md LICENSE /opt/uav-twin/
COPY calibration /opt/uav-twin/calibration
COPY discrepancy /opt/uav-twin/discrepancy
COPY fe /opt/uav-twin/fe
COPY fmu_asset /opt/uav-twin/fmu_asset
COPY reporting /opt/uav-twin/reporting
COPY scenarios /opt/uav-twin/scenarios
COPY twin_master /opt/uav-twin/twin_master
COPY uav_twin /opt/uav-twin/uav_twin
RUN pip install --no-cache-dir --no-deps --no-build-isolation /opt/uav-twin

# Any user may run it: what is kept between runs is in a folder that all may write.
ENV XDG_CACHE_HOME=/var/cache/uav-twin
RUN mkdir -m 1777 /var/cache/uav-twin
WORKDIR /work
ENTRYPOINT ["uav-twin"]
CMD ["--help"]
