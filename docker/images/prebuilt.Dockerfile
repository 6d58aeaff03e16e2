# The image that the others take their files from, out of a folder that collect.sh has filled:
#   docker/images/collect.sh target/release /tmp/out && docker build -f docker/images/prebuilt.Dockerfile -t caudata/build /tmp/out
FROM scratch
COPY . /out/
