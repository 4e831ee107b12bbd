"""Make the starting policy of reviews that is installed with the package (about four minutes of CPU).

    python benchmarks/start_reviews.py

It is what cloning makes with the default settings, rounded to half precision. Run it when the grammar changes or
`cloning.RECIPE` is raised: a test says so.
"""

from prefrl.envs.reviews import reviews, source
from prefrl.envs.text import SHIPPED
from prefrl.policies.cloning import CloningSettings

if __name__ == "__main__":
    CloningSettings().ship(reviews().sample, source(), SHIPPED)
    print(f"written: {SHIPPED}")
