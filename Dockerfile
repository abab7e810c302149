# docker build -t gripper-force .
# docker run --rm -v "$PWD/runs:/data/runs" gripper-force grasp --object sponge --target-n 4
FROM python:3.13-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libegl-mesa0 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*
COPY . /src
RUN pip install --no-cache-dir --extra-index-url https://download.pytorch.org/whl/cpu '/src[report,sim,train]' \
    && rm -rf /src
WORKDIR /data
ENTRYPOINT ["gripper-force"]
CMD ["grasp"]
