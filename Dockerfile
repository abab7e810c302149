# docker build -t gripper-force .
# mkdir -p runs
# docker run --rm --user "$(id -u):$(id -g)" -v "$PWD/runs:/data/runs" gripper-force grasp --object sponge --target-n 4
FROM python:3.13-slim-trixie
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libegl-mesa0 libgl1-mesa-dri libopengl0 \
    && rm -rf /var/lib/apt/lists/*
# Sources and pip's downloads are mounted, so neither gets into the image.
RUN --mount=type=bind,target=/src --mount=type=cache,target=/root/.cache/pip \
    pip install '/src[calibrate,report,sim]'
# Any user may be given by --user, even one without an account.
RUN install -d -m 1777 /data /data/runs
ENV HOME=/tmp
USER 1000:1000
WORKDIR /data
ENTRYPOINT ["gripper-force"]
CMD ["grasp"]
