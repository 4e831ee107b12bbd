"""Our own grammar of short reviews: films, meals, hotels, books and gadgets, praised, panned, or a bit of both.

A prompt fixes the subject and says nothing good or bad; a stance is chosen after it, and kept unless a `but` turns it.
"""

from __future__ import annotations

from prefrl.envs.grammar import Grammar, parse

SUBJECTS = ("film", "meal", "hotel", "book", "gadget")

SHARED = """
review = <film> | <meal> | <hotel> | <book> | <gadget>
when = yesterday | last week | on friday | on sunday | last month | twice this year | with my sister *0.5 | with a
  colleague *0.5
tip = a colleague told me about | my sister chose | we picked | i read about | my neighbour suggested | i wrote down
very = very | really | so | truly | quite | extremely | remarkably
simply = simply | absolutely | really | truly | just
fine = good | great | excellent | wonderful | amazing | fantastic | superb | brilliant | lovely | perfect | delightful
foul = bad | terrible | awful | horrible | poor | dreadful | disappointing | pathetic | dull | lousy | miserable
mild_good = not bad | good enough | better than expected | pretty good | well worth it
mild_bad = not good | not great | worse than expected | pretty bad | hardly worth it | a bit weak
felt_good = loved | enjoyed | adored | liked | really enjoyed | truly loved | admired | really liked
felt_bad = hated | disliked | regretted | resented | really disliked | did not like | did not enjoy | never liked
mood_good = happy | delighted | impressed | pleased | thrilled | charmed | relaxed
mood_bad = unhappy | angry | annoyed | disappointed | bored | frustrated | upset | tired
left_good = it left me <mood_good> | we were both <mood_good> | i was <very> <mood_good> | my sister was <mood_good> too
left_bad = it left me <mood_bad> | we were both <mood_bad> | i was <very> <mood_bad> | my sister was <mood_bad> too
end_good = <advise_good> . *4 | <exclaim_good> ! *2 | thank you ! | <left_good> . *3
advise_good = i would gladly <again> | i recommend it <to> | it is worth every penny | five stars from me | it
  deserves <award>
award = an award | a prize | more praise | all the praise
exclaim_good = what a <fine> <thing_good> | simply <fine> | best of the year | i am so happy with it
thing_good = surprise | find | treat | experience
end_bad = <advise_bad> . *4 | <exclaim_bad> ! *2 | never again ! | <left_bad> . *3
advise_bad = i would never <again> | i cannot recommend it <to> | it is not worth a penny | one star from me | <avoid>
avoid = avoid it if you can | please stay away | it was a waste of money | i want my money back
exclaim_bad = what a <foul> <thing_bad> | simply <foul> | worst of the year | i am so sorry i tried it
thing_bad = mess | mistake | experience | disaster
mixed = i am not sure what to think . | three stars from me . | it depends on the day . | make of that what you will .
again = do it again | come back for it | pick it again | suggest it to my family
to = to anyone | to my friends | to families | to everyone | _ *2
"""

TEMPLATE = """
@ = <@_one> / <@_after> *3 | <@_many> / <@_after> *2 | <@_event> and / <@_go> *3 | <@_event> . / <@_rest> *3
@_one = the <@_part> of this <@_name> was *2 | the <@_part> of the <@_name> was | i think the <@_part> was *2 | this
  <@_name> was
@_many = the <@_parts> of this <@_name> were *2 | the <@_parts> of the <@_name> were | i think the <@_parts> were *2
@_event = <tip> this <@_name> *2 | <@_did> <when> *3
@_after = <@_good> <@_more_good> *6 | <@_bad> <@_more_bad> *8 | <@_good> <@_turn_bad> | <@_bad> <@_turn_good>
@_go = <@_said_good> <@_more_good> *6 | <@_said_bad> <@_more_bad> *8 | <@_said_good> <@_turn_bad> | <@_said_bad>
  <@_turn_good>
@_rest = <@_line_good> <@_close_good> *6 | <@_line_bad> <@_close_bad> *8 | <@_said_good> <@_turn_bad> | <@_said_bad>
  <@_turn_good>
@_more_good = . <@_close_good> *4 | , and <@_said_good> . <@_close_good> *3 | ! <@_close_good>
@_more_bad = . <@_close_bad> *4 | , and <@_said_bad> . <@_close_bad> *3 | ! <@_close_bad>
@_turn_good = , but <@_said_good> . <mixed> | , although <@_said_good> . <mixed> | . still , <@_said_good> . <mixed>
@_turn_bad = , but <@_said_bad> . <mixed> | , although <@_said_bad> . <mixed> | . still , <@_said_bad> . <mixed>
@_close_good = <@_line_good> <end_good> *2 | <@_line_good>
@_close_bad = <@_line_bad> <end_bad> *2 | <@_line_bad>
@_line_good = <@_said_good> . *3 | <@_said_good> and <@_said_good> . | <@_said_good> ! | in short , <@_said_good> .
@_line_bad = <@_said_bad> . *3 | <@_said_bad> and <@_said_bad> . | <@_said_bad> ! | in short , <@_said_bad> .
@_good = <very> <@_nice> *2 | <@_nice> *2 | <fine> *2 | <simply> <fine> | <@_nice> and <@_nice> | <mild_good>
@_bad = <very> <@_nasty> *2 | <@_nasty> *2 | <foul> *2 | <simply> <foul> | <@_nasty> and <@_nasty> | <mild_bad>
@_said_good = the <@_part> was <@_good> *3 | the <@_parts> were <@_good> *2 | i <felt_good> the <@_any> *3 |
  <@_fact_good> *2 | <left_good>
@_said_bad = the <@_part> was <@_bad> *3 | the <@_parts> were <@_bad> *2 | i <felt_bad> the <@_any> *3 | <@_fact_bad>
  *2 | <left_bad>
@_any = <@_part> | <@_parts>
"""

LEXICON = """
film_name = film | movie | drama | western | remake
film_did = i saw this film | we watched the movie | i went to the cinema | we rented this remake
film_part = plot | acting | ending | camera work | dialogue | soundtrack | opening scene | lead actor | editing
film_parts = actors | songs | stunts | costumes | action scenes | side stories | effects
film_nice = funny | moving | clever | gripping | beautiful | charming | touching | original | entertaining | inspiring
film_nasty = boring | predictable | silly | annoying | ridiculous | tedious | stupid | confusing | lame | messy
film_fact_good = the whole room laughed with joy | it made me smile all evening | i cried happy tears | it kept me
  engaged to the end
film_fact_bad = half the room left early in disgust | it put me in a bad mood | i nearly fell asleep from boredom | it
  insulted the audience
meal_name = meal | dinner | lunch | restaurant | menu
meal_did = we had dinner there | i ate lunch at this place | we tried the new menu | i ordered the soup
meal_part = soup | bread | sauce | coffee | service | pasta | curry | dessert | wine | table by the window
meal_parts = noodles | vegetables | starters | portions | pancakes | side dishes
meal_nice = delicious | fresh | tasty | rich | generous | comforting | delightful | heavenly | satisfying
meal_nasty = cold | bland | disgusting | greasy | sour | nasty | stale | gross | overpriced
meal_fact_good = a friendly chef came out with a warm smile | every bite was a joy | they gave us a free cake | we
  laughed and shared a great bottle
meal_fact_bad = i found a hair in it and felt sick | a rude waiter ignored our complaint | we waited an hour in misery
  | they ruined our evening
hotel_name = hotel | guest house | resort | hostel | inn
hotel_did = we stayed at this hotel | i spent a night at the inn | we booked the guest house | i slept at this hostel
hotel_part = room | bed | breakfast | pool | view | bathroom | shower | reception | garden
hotel_parts = beds | towels | rooms | pillows | hallways | windows
hotel_nice = clean | comfortable | elegant | charming | peaceful | welcoming | gorgeous | relaxing | spotless
hotel_nasty = dirty | noisy | shabby | smelly | filthy | uncomfortable | ugly | damp
hotel_fact_good = the staff greeted us with a warm welcome | we slept like happy children | they gave us a free
  upgrade | the sunrise was a gift
hotel_fact_bad = there was an ugly smell in the hall | the staff lost our booking and blamed us | the noise was a
  nightmare | someone stole my charger
book_name = book | paperback | story | memoir | guide
book_did = i read this book | i finished the paperback | we discussed the story | i listened to the memoir
book_part = plot | writing | main character | first chapter | ending | style | narrator | cover | translation
book_parts = characters | chapters | pictures | dialogues | poems | footnotes | twists
book_nice = clever | moving | gripping | beautiful | thoughtful | fascinating | honest | witty | inspiring | brilliant
book_nasty = boring | confusing | lifeless | dull | pretentious | tedious | pointless | clumsy | shallow | irritating
book_fact_good = i smiled on every page | it gave me hope | it won my heart | i shared it with my best friends | it
  made me laugh out loud
book_fact_bad = i gave up after the second chapter in anger | it wasted my weekend | it hurt my head | the twist was
  an insult | i struggled with every page
gadget_name = phone | camera | speaker | tablet | kettle
gadget_did = i bought this speaker | we ordered the camera | i tried the new phone | i replaced my old tablet
gadget_part = battery | screen | sound | design | manual | keyboard | charger | price | setup
gadget_parts = buttons | cables | speakers | menus | photos | updates | features
gadget_nice = useful | reliable | clever | impressive | elegant | easy to use | bright | powerful | helpful | handy
gadget_nasty = useless | broken | slow | unreliable | ugly | weak | faulty | cheap and nasty | annoying | defective
gadget_fact_good = it works like a dream | it makes my life easier | support was friendly and helpful | it is a
  pleasure to hold
gadget_fact_bad = it failed after a week | it crashed and lost my photos | support was rude and unhelpful | it gave me
  a headache
"""


def reviews() -> Grammar:
    """The grammar of all five subjects."""
    return parse(source(), "review")


def source() -> str:
    """The rules as text: their digest is part of the key under which a model trained on them is kept."""
    return SHARED + LEXICON + "".join(TEMPLATE.replace("@", subject) for subject in SUBJECTS)
